"""An HTML page that opens from disk: a title, large numbers, sections with images inside."""

import base64
import html
from collections.abc import Iterable, Mapping
from string import Template

_PAGE = Template(
    """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>r3jax $kind: $title</title>
<style>
 body { font: 15px/1.5 system-ui, sans-serif; color: #1f2937; background: #f3f4f6; margin: 0 }
 main { max-width: 1060px; margin: 0 auto; padding: 28px 20px 60px }
 h1 { font-size: 26px; margin: 0 0 6px } h2 { font-size: 18px; margin: 0 0 4px }
 h3 { font-size: 15px; margin: 22px 0 2px }
 .lead { font-size: 17px; color: #374151; margin: 0 0 18px } .lead p { margin: 0 0 6px }
 section { background: white; border-radius: 10px; padding: 18px 22px; margin: 16px 0;
   overflow-x: auto; box-shadow: 0 1px 3px #0001 }
 .cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px }
 .card { background: white; border-radius: 10px; padding: 12px 16px; box-shadow: 0 1px 3px #0001 }
 .card b { display: block; font-size: 23px; line-height: 1.3 } .card span { color: #6b7280;
   font-size: 13px }
 p.note { color: #6b7280; font-size: 13.5px; margin: 0 0 10px }
 p.why { margin: 0 0 6px; font-size: 14px }
 img { max-width: 100%; display: block; margin: 0 auto }
 table { border-collapse: collapse; font-size: 14px; width: 100%; margin-top: 6px }
 th, td { text-align: left; padding: 4px 12px 4px 0; border-bottom: 1px solid #e5e7eb;
   vertical-align: top }
 th { color: #6b7280; font-weight: 600; font-size: 13px }
 td.k { white-space: nowrap }
 td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
 i.dot { display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin-right: 7px }
 i.bar { display: inline-block; height: 9px; border-radius: 3px; margin-left: 8px }
 b.num { display: inline-block; min-width: 21px; height: 21px; border-radius: 11px; color: white;
   background: #075985; text-align: center; font-size: 13px; line-height: 21px;
   margin-right: 6px }
 code { font: 13px ui-monospace, monospace; overflow-wrap: anywhere }
 ul { padding-left: 20px; margin: 4px 0; font-size: 14px; color: #374151 }
</style></head><body><main>
<h1>$title</h1>
<div class="lead">$lead</div>
<div class="cards">$cards</div>
$sections
</main></body></html>
"""
)


def page(
    kind: str,
    title: str,
    lead: Iterable[str],
    cards: Mapping[str, str],
    sections: Iterable[str],
) -> bytes:
    """The whole page.

    Args:
        kind: what is reported on, one word for the browser's tab.
        title: plain text.
        lead: paragraphs of plain text under the title.
        cards: large numbers by what they are.
        sections: made by `section`.
    """
    card = '<div class="card"><b>{}</b><span>{}</span></div>'
    text = _PAGE.substitute(
        kind=html.escape(kind),
        title=html.escape(title),
        lead="".join(f"<p>{html.escape(paragraph)}</p>" for paragraph in lead),
        cards="".join(card.format(html.escape(v), html.escape(k)) for k, v in cards.items()),
        sections="\n".join(sections),
    )
    return text.encode()


def section(title: str, note: str, body: str) -> str:
    """A part of the page; the title, the note and the body are HTML, the note may be empty."""
    lead = f'<p class="note">{note}</p>' if note else ""
    return f"<section><h2>{title}</h2>{lead}{body}</section>"


def image(png: bytes, alt: str = "") -> str:
    """An image inside the page, so that the page can be sent as one file."""
    data = base64.b64encode(png).decode()
    return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{data}">'
