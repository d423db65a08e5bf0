"""The report of an audit: one HTML page that opens from disk, with everything inside."""

import html
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from r3jax.apps.audit.audit import Audit
from r3jax.apps.audit.bad_regions import Region
from r3jax.apps.audit.outputs import suggested_poses
from r3jax.apps.audit.pages import audit_figures, sentences
from r3jax.apps.audit.pages.audit_colors import COLOR_OF_CAUSE
from r3jax.apps.audit.pages.audit_figures import region_figure
from r3jax.apps.audit.pages.faults_section import faults_section
from r3jax.apps.audit.pages.ground_plan import letter, plan_figure
from r3jax.apps.audit.suggest import Suggestion
from r3jax.files import write_atomic
from r3jax.plots import style
from r3jax.plots.page import image, page, section


def write_report(audit: Audit, folder: Path, files: Iterable[Path] = ()) -> Path:
    """Writes `report.html`.

    Args:
        audit: what was found.
        folder: a folder that exists.
        files: what lies beside the page, to be named on it.

    Returns:
        The page; its images are inside it, so that it can be sent as one file.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    parts = [
        faults_section(audit),
        section(
            "From above",
            "Letters: regions to mend, in the color of their cause; dotted circles: where the "
            "capture ends. Numbers: suggested views, the wedge is what they show. Dots: frames, "
            "from red (low renderability) to green. Everything above the cameras' heads is left "
            "out.",
            _image(plan_figure(audit)),
        ),
        section(
            "What is wrong, and how much of it",
            "Shares of the surface that one sees from where people could stand."
            if audit.source.is_dense
            else "Shares of what the frames show, each judged by the other pictures.",
            _cause_table(audit),
        ),
        section(
            "Where it is worst", _region_note(audit), _region_pictures(audit) + _region_table(audit)
        ),
    ]
    if audit.plan.views:
        parts.append(_views_section(audit))
    parts += [_frames_section(audit), _panorama_section(audit), _method_section(audit, files)]
    title = f"Audit of {audit.source.name}"
    path = folder / "report.html"
    write_atomic(path, page("audit", title, sentences.verdict(audit), _cards(audit), parts))
    return path


def _cards(audit: Audit) -> dict[str, str]:
    found, plan = audit.diagnosis, audit.plan
    if audit.survey.is_one_place:
        return {"pictures": str(len(audit.survey.chosen)), "taken from": "one place"}
    fine = f"{100 * sentences.cause_share(audit, 'fine'):.0f} %"
    what = "pictures" if audit.source.has_images else "poses without pictures"
    cards = {what: str(len(audit.survey.chosen))}
    if audit.source.is_dense:
        bad = (1.0 - found.fine_share) * found.is_seen.sum() * audit.survey.voxel_size**2
        cards["of the surface renders well"] = fine
        cards["of surface to mend"] = sentences.area(audit, float(bad))
    else:
        cards["of what they show renders well"] = fine
        cards["of it is not known"] = f"{100 * audit.shares['unseen']:.0f} %"
    zero = "" if audit.source.is_dense else ", what is not known as 0"
    cards[f"mean R of the frames{zero}"] = f"{audit.renderability.mean():.2f}"
    if plan.views:
        gain = f"{found.mean:.2f} → {plan.after.mean:.2f}"
        where = "" if audit.source.is_dense else " with points"
        cards[f"mean R of the surfaces{where} after {len(plan.views)} views"] = gain
    return cards


def _cause_table(audit: Audit) -> str:
    found, is_dense = audit.diagnosis, audit.source.is_dense
    whole = float(found.is_seen.sum()) * audit.survey.voxel_size**2
    rows: list[str] = []
    for cause, meaning in sentences.MEANING.items():
        is_edge = cause == "unseen" and is_dense  # where free space ends, which has an area only
        if is_edge and not audit.unseen:
            continue
        share = None if is_edge else sentences.cause_share(audit, cause)
        covers = audit.unseen_area if share is None else share * whole
        name, remedy = cause, sentences.REMEDY[cause]
        if cause == "unseen" and not is_dense:
            name, meaning, remedy = sentences.NOT_KNOWN
        bar = "" if share is None else _bar(share, COLOR_OF_CAUSE[cause])
        amount = "" if share is None else f"{100 * share:.0f} %"
        about = sentences.area(audit, covers) if is_dense else ""
        if cause == "noise" and not audit.source.has_images:
            bar, amount, about = "", "not known", ""
        rows.append(
            f"<tr><td class=k>{_dot(cause)}{name}</td><td class=n>{amount}</td><td>{bar}</td>"
            f"<td class=n>{about}</td><td>{meaning}</td><td>{remedy}</td></tr>"
        )
    head = (
        "<tr><th>cause</th><th class=n>share</th><th></th>"
        f"<th class=n>{'about' if is_dense else ''}</th><th>meaning</th>"
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
    where = "" if audit.source.is_dense else " among the surfaces with points"
    return f"<table>{head}{''.join(rows)}</table>" if rows else f"<p>Nowhere{where}.</p>"


def _shows(view: Suggestion, region: Region) -> bool:
    """True if a view shows most of a region."""
    shown = view.cells if region.cause == "unseen" else view.shown
    return len(region.rows) > 0 and float(np.isin(region.rows, shown).mean()) >= 0.5


def _views_section(audit: Audit) -> str:
    parts = [_image(audit_figures.gain_figure(audit))]
    poses = suggested_poses(audit)
    drawn = audit_figures.view_figures(audit)
    for number, (view, pose, figure) in enumerate(
        zip(audit.plan.views, poses, drawn, strict=True), start=1
    ):
        like, gap = audit_figures.likest_picture(audit, view)
        near = html.escape(audit.source.labels[like])
        letters = [
            letter(i)
            for i, region in enumerate((*audit.regions, *audit.unseen))
            if _shows(view, region)
        ]
        parts.append(
            f'<h3><b class="num">{number}</b>'
            f"{html.escape(sentences.directions(audit, view, like))}</h3>"
            f'<p class="why">{html.escape(sentences.reason(audit, view, letters))}. The most '
            f"similar picture so far, {near}, was taken {sentences.length(audit, gap)} away. "
            f"Pose: at ({sentences.point(pose[:3, 3])}), looking along "
            f"({sentences.point(pose[:3, 2])}).</p>" + _image(figure)
        )
    note = (
        "In this order: each is imagined as taken before the next is chosen. Poses are in "
        "<code>suggested.json</code> (nerfstudio's camera path) and "
        "<code>suggested_transforms.json</code>, in the capture's own coordinates."
    )
    return section("Which views would help most", note, "".join(parts))


def _frames_section(audit: Audit) -> str:
    own = (
        "Each frame is scored by a map that lacks it, as a held-out view."
        if audit.is_own_path
        else "Each frame of the path is scored by the map of all pictures."
    )
    body = _image(audit_figures.frames_figure(audit))
    if audit.is_saturated:
        body = f"<p>{html.escape(sentences.saturation())}</p>{body}"
    else:
        body += "<h3>The worst</h3>" + _image(audit_figures.worst_figure(audit))
    return section("How well the frames would render", own, body)


def _panorama_section(audit: Audit) -> str:
    note = (
        "All directions from some of the standpoints; the middle of a picture is the first axis "
        "along the ground. Directions without a voxel are drawn apart: those that are free up to "
        "the sensor's range, and those that no picture shows."
    )
    return section("Looking round", note, _image(audit_figures.panorama_strip(audit)))


def _method_section(audit: Audit, files: Iterable[Path]) -> str:
    items = "".join(f"<li>{html.escape(text)}</li>" for text in sentences.method(audit))
    names = ", ".join(f"<code>{html.escape(path.name)}</code>" for path in files)
    beside = f"<p class=note>Beside this page: {names}.</p>" if names else ""
    return section("How this was computed", "", f"<ul>{items}</ul>{beside}")


def _image(figure: Figure) -> str:
    return image(style.to_png(figure))
