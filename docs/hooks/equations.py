"""Equations as MathML, which browsers draw by themselves: no script, nothing from the net."""

import html
import re

from latex2mathml.converter import convert

_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def on_page_content(page_html: str, **kwargs: object) -> str:
    """Replaces what `pymdownx.arithmatex` marked as TeX."""
    page_html = _INLINE.sub(lambda found: _mathml(found[1], "inline"), page_html)
    block = lambda found: f'<div class="equation">{_mathml(found[1], "block")}</div>'
    return _BLOCK.sub(block, page_html)


def _mathml(tex: str, display: str) -> str:
    text = convert(html.unescape(tex), display=display)
    return text.replace("<mo>&#x23DF;</mo>", '<mo stretchy="true">&#x23DF;</mo>')  # underbraces
