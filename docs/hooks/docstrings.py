"""Docstrings are written to be read as text; two of their habits mean something to Markdown."""

import re

import griffe


class PlainText(griffe.Extension):
    """Lets shapes with units, and lists of symbols, stand on the pages as in the source."""

    def on_object(self, *, obj: griffe.Object, **kwargs: object) -> None:
        """Called for each module, class, function and attribute once its docstring is known."""
        if obj.docstring is None:
            return
        text = obj.docstring.value
        # `[2, 3] [m]`, a shape and its unit, would be a link to a page m.
        text = re.sub(r"\] \[", r"] \\[", text)
        # A heading and an indented block would be a box with all lines run together.
        text = re.sub(r"^(Shape symbols[^\n]*:)\n(?=    )", r"\1\n\n", text, flags=re.MULTILINE)
        obj.docstring.value = text
