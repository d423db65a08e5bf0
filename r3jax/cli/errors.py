"""Errors that end a command with one line and no traceback."""


class UserError(Exception):
    """Something that the user can mend, in one line."""


def one_line(error: BaseException) -> str:
    """An error's text without line breaks."""
    return " ".join(str(error).split())
