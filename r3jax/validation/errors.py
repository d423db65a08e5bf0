"""What is wrong with a file; the reader that knows which file it is adds the name."""


class ForeignFileError(ValueError):
    """A reason not to read on."""
