"""The report of an audit: one HTML page that opens from disk, with everything inside."""

import base64
import html
from collections.abc import Iterable
from pathlib import Path
from string import Template

import numpy as np
from matplotlib.figure import Figure

from r3jax.audit import figures, sentences
from r3jax.audit.audit import Audit
from r3jax.audit.colors import COLOR_OF_CAUSE
from r3jax.audit.ground_plan import letter, plan_figure
from r3jax.audit.outputs import suggested_poses
from r3jax.audit.region_pictures import region_figure
from r3jax.audit.regions import Region
from r3jax.audit.suggest import Suggestion
from r3jax.evaluation import style
from r3jax.files import write_atomic

_PAGE = Template(
    """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>r3jax audit: $title</title>
<style>
 body { font: 15px/1.5 system-ui, sans-serif; color: #1f2937; background: #f3f4f6; margin: 0 }
 main { max-width: 1060px; margin: 0 auto; padding: 28px 20px 60px }
 h1 { font-size: 26px; margin: 0 0 6px } h2 { font-size: 18px; margin: 0 0 4px }
 h3 { font-size: 15px; margin: 22px 0 2px }
 .lead { font-size: 17px; margin: 0 0 18px } .lead p { margin: 0 0 6px }
 section { background: white; border-radius: 10px; padding: 18px 22px; margin: 16px 0;
   box-shadow: 0 1px 3px #0001 }
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


def write_report(audit: Audit, folder: Path, files: Iterable[Path] = ()) -> Path:
    """Writes `report.html`.

    Args:
        audit: what was found.
        folder: a folder that exists.
        files: what lies beside the page, to be named on it.

    Returns:
        The page; its pictures are inside it, so that it can be sent as one file.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    parts = [
        _section(
            "From above",
            "Letters: regions to mend, in the color of their cause; dotted circles: where the "
            "capture ends. Numbers: suggested views, the wedge is what they show. Dots: frames, "
            "from red (low renderability) to green. Everything above the cameras' heads is left "
            "out.",
            _image(plan_figure(audit)),
        ),
        _section(
            "What is wrong, and how much of it",
            "Shares of the surface that one sees from where people could stand.",
            _cause_table(audit),
        ),
        _section(
            "Where it is worst", _region_note(audit), _region_pictures(audit) + _region_table(audit)
        ),
    ]
    if audit.plan.views:
        parts.append(_views_section(audit))
    parts += [_frames_section(audit), _panorama_section(audit), _method_section(audit, files)]
    page = _PAGE.substitute(
        title=html.escape(f"Audit of {audit.source.name}"),
        lead="".join(f"<p>{html.escape(text)}</p>" for text in sentences.verdict(audit)),
        cards=_cards(audit),
        sections="\n".join(parts),
    )
    path = folder / "report.html"
    write_atomic(path, page.encode())
    return path


def _cards(audit: Audit) -> str:
    found, plan = audit.diagnosis, audit.plan
    bad = (1.0 - found.fine_share) * found.is_judged.sum() * audit.survey.voxel_size**2
    cards = {
        "pictures": str(len(audit.survey.chosen)),
        "of the surface renders well": f"{100 * found.fine_share:.0f} %",
        "of surface to mend": sentences.area(audit, float(bad)),
        "mean R of the frames": f"{audit.renderability.mean():.2f}",
    }
    if plan.views:
        gain = f"{found.mean:.2f} → {plan.after.mean:.2f}"
        cards[f"mean R of the surfaces after {len(plan.views)} views"] = gain
    card = '<div class="card"><b>{}</b><span>{}</span></div>'
    return "".join(card.format(html.escape(v), html.escape(k)) for k, v in cards.items())


def _cause_table(audit: Audit) -> str:
    found = audit.diagnosis
    whole = float(found.is_judged.sum()) * audit.survey.voxel_size**2
    rows: list[str] = []
    for cause, meaning in sentences.MEANING.items():
        share = found.share(cause) if cause != "unseen" else None
        covers = audit.unseen_area if share is None else share * whole
        if share is None and not audit.unseen:
            continue
        bar = "" if share is None else _bar(share, COLOR_OF_CAUSE[cause])
        amount = "" if share is None else f"{100 * share:.0f} %"
        rows.append(
            f"<tr><td class=k>{_dot(cause)}{cause}</td><td class=n>{amount}</td><td>{bar}</td>"
            f"<td class=n>{sentences.area(audit, covers)}</td><td>{meaning}</td>"
            f"<td>{sentences.REMEDY[cause]}</td></tr>"
        )
    head = (
        "<tr><th>cause</th><th class=n>share</th><th></th><th class=n>about</th><th>meaning</th>"
        "<th>what to do</th></tr>"
    )
    return f"<table>{head}{''.join(rows)}</table>"


def _bar(share: float, color: str) -> str:
    return f'<i class="bar" style="width:{round(90 * share)}px;background:{color}"></i>'


def _dot(cause: str) -> str:
    return f'<i class="dot" style="background:{COLOR_OF_CAUSE[cause]}"></i>'


def _region_note(audit: Audit) -> str:
    return (
        f"Blocks of {sentences.length(audit, 1.0)}, the largest loss first; coordinates are the "
        "capture's own."
    )


def _region_pictures(audit: Audit) -> str:
    figure = region_figure(audit)
    return "" if figure is None else _image(figure)


def _region_table(audit: Audit) -> str:
    rows: list[str] = []
    for number, region in enumerate((*audit.regions, *audit.unseen)):
        center = audit.survey.alignment.points_back(region.center[None])[0]
        value = "" if region.cause == "unseen" else f"{region.renderability:.2f}"
        share = "" if region.cause == "unseen" else f"{100 * region.bad_share:.0f} %"
        seen_by = [i for i, view in enumerate(audit.plan.views, 1) if _shows(view, region)]
        rows.append(
            f"<tr><td><b>{letter(number)}</b></td>"
            f"<td class=k>{_dot(region.cause)}{region.cause}</td>"
            f"<td class=n>{sentences.area(audit, region.area)}</td><td class=n>{share}</td>"
            f"<td class=n>{value}</td><td class=n>{sentences.point(center)}</td>"
            f"<td class=n>{', '.join(map(str, seen_by)) or '–'}</td></tr>"
        )
    head = (
        "<tr><th></th><th>mostly</th><th class=n>bad</th><th class=n>of the surface there</th>"
        "<th class=n>R of it</th><th class=n>middle (x, y, z)</th><th class=n>views</th></tr>"
    )
    return f"<table>{head}{''.join(rows)}</table>" if rows else "<p>Nowhere.</p>"


def _shows(view: Suggestion, region: Region) -> bool:
    """True if a view shows most of a region."""
    shown = view.cells if region.cause == "unseen" else view.shown
    return len(region.rows) > 0 and float(np.isin(region.rows, shown).mean()) >= 0.5


def _views_section(audit: Audit) -> str:
    parts = [_image(figures.gain_figure(audit))]
    poses = suggested_poses(audit)
    drawn = figures.view_figures(audit)
    for number, (view, pose, figure) in enumerate(
        zip(audit.plan.views, poses, drawn, strict=True), start=1
    ):
        like, gap = figures.likest_picture(audit, view)
        near = html.escape(audit.source.labels[like])
        letters = [
            letter(i)
            for i, region in enumerate((*audit.regions, *audit.unseen))
            if _shows(view, region)
        ]
        parts.append(
            f'<h3><b class="num">{number}</b>at ({sentences.point(pose[:3, 3])}), looking along '
            f"({sentences.point(pose[:3, 2])})</h3>"
            f'<p class="why">{html.escape(sentences.reason(audit, view, letters))}. The likest '
            f"picture so far, {near}, was taken {sentences.length(audit, gap)} away.</p>"
            + _image(figure)
        )
    note = (
        "In this order: each is imagined as taken before the next is chosen. Poses are in "
        "<code>suggested.json</code> (nerfstudio's camera path) and "
        "<code>suggested_transforms.json</code>, in the capture's own coordinates."
    )
    return _section("Which views would help most", note, "".join(parts))


def _frames_section(audit: Audit) -> str:
    own = (
        "Each frame is judged by a map that lacks it, as a held-out view."
        if audit.is_own_path
        else "Each frame of the path is judged by the map of all pictures."
    )
    body = _image(figures.frames_figure(audit)) + "<h3>The worst</h3>"
    body += _image(figures.worst_figure(audit))
    return _section("How well the frames would render", own, body)


def _panorama_section(audit: Audit) -> str:
    note = (
        "All directions from some of the standpoints; the middle of a picture is the first axis "
        "along the ground. Grey: nothing within range."
    )
    return _section("Looking round", note, _image(figures.panorama_strip(audit)))


def _method_section(audit: Audit, files: Iterable[Path]) -> str:
    items = "".join(f"<li>{html.escape(text)}</li>" for text in sentences.method(audit))
    names = ", ".join(f"<code>{html.escape(path.name)}</code>" for path in files)
    beside = f"<p class=note>Beside this page: {names}.</p>" if names else ""
    return _section("How this was computed", "", f"<ul>{items}</ul>{beside}")


def _section(title: str, note: str, body: str) -> str:
    lead = f'<p class="note">{note}</p>' if note else ""
    return f"<section><h2>{title}</h2>{lead}{body}</section>"


def _image(figure: Figure) -> str:
    data = base64.b64encode(style.to_png(figure)).decode()
    return f'<img alt="" src="data:image/png;base64,{data}">'
