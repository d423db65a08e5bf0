"""HTML pages from the package's templates, in which every value is escaped.

A template lies beside the code that fills it and is named from the package's folder on. Pages that
open from disk extend `plots/page.html`.
"""

import base64
import functools
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, **values: Any) -> str:
    """Fills a template.

    Args:
        template: path from the package's folder on, such as `plots/page.html`.
        values: by their names in the template; text is escaped there, wherever it came from.

    Raises:
        UndefinedError: the template needs a value that is not given.
    """
    return _environment().get_template(template).render(values)


def render_macro(template: str, macro: str, **values: Any) -> str:
    """Fills one macro of a template; the macro takes no arguments, it reads the values by name.

    Args:
        template: as in `render`.
        macro: its name.
        values: as in `render`.

    Raises:
        UndefinedError: the macro needs a value that is not given.
    """
    module = _environment().get_template(template).make_module(values)
    return str(getattr(module, macro)())


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("r3jax", ""),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters["data_url"] = data_url
    return environment


def data_url(image: bytes, kind: str = "png") -> str:
    """Encodes an image as a data URL, so that a page is a single file."""
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
