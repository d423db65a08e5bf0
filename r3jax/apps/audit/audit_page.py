"""Writes the report of an audit: one self-contained HTML page that opens from disk."""

import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.apps.audit import audit_figures, sentences
from r3jax.apps.audit.audit import Audit
from r3jax.apps.audit.audit_figures import COLOR_OF_CAUSE, plan_figure, value_figure
from r3jax.apps.audit.diagnosis import NOT_KNOWN, Region
from r3jax.apps.audit.directions import way_to
from r3jax.apps.audit.outputs import Preview, suggested_poses
from r3jax.apps.audit.suggest import Suggestion, promise
from r3jax.captures.faults.faults import Finding
from r3jax.files import write_atomic
from r3jax.plots.page import render
from r3jax.plots.pictures import small_png
from r3jax.plots.style import to_png

_SHOWN = 8
"""Maximum number of pictures shown for a finding."""

_SIDE = 230
"""Longer side of a picture on the page [px]."""

_BAR = 90
"""Width of the bar of a cause with a share of 100 % [px]."""


def write_report(
    audit: Audit,
    folder: Path,
    files: Iterable[Path] = (),
    *,
    capture: Path | None = None,
    preview: Preview | None = None,
) -> Path:
    """Writes `report.html`.

    Args:
        audit: the result.
        folder: an existing folder.
        files: names of the files beside the page, which it lists.
        capture: path of the audited capture, for the commands that the page shows.
        preview: images of a splat of the capture, if one was trained.

    Returns:
        Path of the page; its images are embedded, so that it can be sent as one file.

    Raises:
        OSError: for example, the disk is full or not writable.
    """
    region_figure = audit_figures.region_figure(audit)
    is_ranked = not audit.is_saturated
    page = render(
        "apps/audit/audit_page.html",
        kind="audit",
        title=f"Audit of {audit.source.name}",
        lead=sentences.first_things(audit),
        cards={},
        state=sentences.state(audit),
        headline=sentences.headline(audit),
        advice=sentences.advice(audit),
        verdict=sentences.verdict(audit),
        numbers=_cards(audit),
        seen_from=audit.places.seen_from,
        colors=COLOR_OF_CAUSE,
        is_complete=audit.source.is_complete,
        is_own_path=audit.is_own_path,
        pictures=picture_faults(audit),
        plan=to_png(plan_figure(audit)),
        values=to_png(value_figure(audit)),
        causes=_causes(audit),
        reconstruction=_reconstruction(audit),
        block=sentences.length(audit, 1.0),
        region_pictures=None if region_figure is None else to_png(region_figure),
        regions=_regions(audit),
        gain=_gain(audit),
        views=_views(audit),
        frames=to_png(audit_figures.frames_figure(audit)),
        worst=to_png(audit_figures.worst_figure(audit)) if is_ranked else None,
        saturation=sentences.saturation(),
        panorama=to_png(audit_figures.panorama_strip(audit)),
        method=sentences.method(audit),
        files=[path.name for path in files],
        stills=[] if preview is None else preview.stills,
        view_command=f"r3jax view {shlex.quote(str(folder))}",
        select_command=sentences.select_command(capture),
    )
    path = folder / "report.html"
    write_atomic(path, page.encode())
    return path


def _gain(audit: Audit) -> bytes | None:
    """Draws the expected gain, or returns None without a depth camera."""
    is_promised = audit.plan.views and audit.source.is_complete
    return to_png(audit_figures.gain_figure(audit)) if is_promised else None


def _cards(audit: Audit) -> dict[str, str]:
    found, plan = audit.diagnosis, audit.plan
    if audit.survey.is_one_place:
        return {"pictures": str(len(audit.survey.chosen)), "taken from": "one place"}
    fine = f"{100 * sentences.cause_share(audit, 'fine'):.0f} %"
    what = "pictures" if audit.source.has_images else "poses without pictures"
    cards = {what: str(len(audit.survey.chosen))}
    if audit.source.is_complete:
        bad = (1.0 - found.fine_share) * found.is_seen.sum() * audit.survey.voxel_size**2
        cards["of the surface is seen well enough"] = fine
        cards["of surface that needs more views"] = sentences.area(audit, float(bad))
    else:
        cards["of their pixels are seen well enough"] = fine
        cards["of their pixels are not known"] = f"{100 * audit.shares[audit.unknown]:.0f} %"
    where = "" if audit.source.is_complete else ", where it is known"
    cards[f"mean R of the frames{where}"] = f"{audit.mean_renderability:.2f}"
    if plan.views and audit.source.is_complete:
        low, _, high = (100 * share for share in promise(plan))
        what = f"seen well enough after {len(plan.views)} more pictures (in 8 of 10 captures)"
        cards[what] = f"{low:.0f} to {high:.0f} %"
    return cards


def picture_faults(audit: Audit) -> dict[str, Any]:
    """Returns findings, remarks and notes about single pictures.

    If there are no findings, a remark takes their place. A remark also reports that the poses
    contradict each other.
    """
    faults = audit.faults
    findings = [_finding(audit, finding) for finding in faults.findings]
    remarks = [] if findings or not faults.fits else [_nothing_found(audit)]
    if not faults.fits:
        remarks.append(sentences.CONTRADICTED)
    notes: list[str] = []
    alone = faults.looked_at - faults.compared - len(faults.without_depth)
    if not faults.compared:
        findings, remarks = [], ["Cannot check: no two pictures overlap."]
    elif alone > 0 and faults.fits:
        notes.append(
            f"{alone} of the {faults.looked_at} pictures could not be checked: no other one "
            "shows the same surface."
        )
    unsaid = sum(value is None for value in faults.record.get("detail", []))
    if unsaid > alone:
        notes.append(
            f"{unsaid} of the {faults.looked_at} pictures could not be checked for blur: that "
            "takes two others of the same surface, from about the same side."
        )
    return {"findings": findings, "remarks": remarks, "notes": notes}


def _nothing_found(audit: Audit) -> str:
    """Describes the faults that were searched for and not found.

    Only faults that could be measured are mentioned.
    """
    record = audit.faults.record
    known = lambda name: any(value is not None for value in record.get(name, []))
    good = [
        word for word, name in (("sharp", "detail"), ("evenly lit", "brightness")) if known(name)
    ]
    if audit.source.is_complete and known("pose_off_by"):
        good.append("consistent with their poses")
    if not audit.source.has_images:
        poses = ", but the depth images are consistent with their poses." if good else "."
        return "The pictures are missing" + poses
    if not good:
        return "The pictures could not be compared."
    return f"No problems found: as far as they can be compared, they are {sentences.listed(good)}."


def _finding(audit: Audit, finding: Finding) -> dict[str, Any]:
    labels = audit.source.labels
    shown = zip(finding.frames[:_SHOWN], finding.captions, strict=False)
    return {
        "title": sentences.TITLES[finding.kind],
        "what": finding.what,
        "todo": finding.todo,
        "shown": [
            {"png": _thumbnail(audit, index), "label": labels[index], "caption": caption}
            for index, caption in shown
        ],
        "more": [labels[index] for index in finding.frames[_SHOWN:]],
    }


def _thumbnail(audit: Audit, index: int) -> bytes:
    """Returns a small PNG of an image of the capture, with the vertical pointing up."""
    rgb, _ = audit.source.read(index)
    up = audit.survey.alignment.rotation.T @ [0.0, 0.0, 1.0]
    return small_png(rgb, audit.source.poses[index], up, _SIDE)


def _reconstruction(audit: Audit) -> list[dict[str, str]]:
    """Lists the standard quality measures of structure from motion, with their usual values."""
    found = audit.source.reconstruction
    if found is None:
        return []
    numbers = (
        ("pictures with a pose", f"{found.posed} of {found.pictures}", "95 % or more"),
        ("reprojection error, median", _number(found.error_median, " px"), "0.4 to 1 px"),
        ("reprojection error, 95th percentile", _number(found.error_p95, " px"), "below 2 px"),
        ("pictures that see a point, mean", _number(found.track_length, ""), "4 or more"),
        ("angle between a point's rays, median", _number(found.angle, "°"), "5 to 30°"),
    )
    return [{"name": name, "value": value, "usual": usual} for name, value, usual in numbers]


def _number(value: float | None, unit: str) -> str:
    return "not known" if value is None else f"{value:.2g}{unit}"


def _causes(audit: Audit) -> list[dict[str, Any]]:
    """Returns a table row for each cause."""
    found, is_complete = audit.diagnosis, audit.source.is_complete
    whole = float(found.is_seen.sum()) * audit.survey.voxel_size**2
    rows: list[dict[str, Any]] = []
    for cause, meaning in sentences.MEANING.items():
        if cause == NOT_KNOWN and is_complete:
            continue
        # The edge of free space has an area but no share.
        is_edge = cause == "unseen" and is_complete
        if is_edge and not audit.unseen:
            continue
        share = None if is_edge else sentences.cause_share(audit, cause)
        covers = audit.unseen_area if share is None else share * whole
        name, remedy = cause.replace("_", " "), sentences.REMEDY[cause]
        if not is_complete:
            meaning = sentences.OF_PIXELS.get(cause, meaning)
        row = {"cause": cause, "name": name, "meaning": meaning, "remedy": remedy}
        if cause == "noise" and not audit.source.has_images:
            rows.append(row | {"share": "not known", "width": None, "about": ""})
            continue
        rows.append(
            row
            | {
                "share": "" if share is None else f"{100 * share:.0f} %",
                "width": None if share is None else round(_BAR * share),
                "about": sentences.area(audit, covers) if is_edge or is_complete else "",
            }
        )
    return rows


def _regions(audit: Audit) -> list[dict[str, Any]]:
    """Returns a table row for each bad region and for each unseen place."""
    rows: list[dict[str, Any]] = []
    for number, region in enumerate(audit.all_regions):
        center = audit.survey.alignment.points_back(region.center[None])[0]
        rows.append(
            {
                "letter": sentences.region_letter(number),
                "cause": region.cause,
                "area": sentences.area(audit, region.area),
                "name": region.cause.replace("_", " "),
                "share": f"{100 * region.bad_share:.0f} %" if region.is_known else "",
                "value": f"{region.renderability:.2f}" if region.is_known else "",
                "middle": sentences.point(center),
                "views": [i for i, view in enumerate(audit.plan.views, 1) if _shows(view, region)],
            }
        )
    return rows


def _shows(view: Suggestion, region: Region) -> bool:
    """Returns True if a view shows most of a region."""
    shown = view.cells if region.cause == "unseen" else view.shown
    return len(region.rows) > 0 and float(np.isin(region.rows, shown).mean()) >= 0.5


def _views(audit: Audit) -> list[dict[str, Any]]:
    """Describes every suggested view: the path to it, the reason, its pose, and what it shows."""
    described: list[dict[str, Any]] = []
    regions = audit.all_regions
    for view, pose in zip(audit.plan.views, suggested_poses(audit), strict=True):
        way = way_to(audit.source, audit.survey, audit.seen, view)
        letters = [
            sentences.region_letter(i) for i, region in enumerate(regions) if _shows(view, region)
        ]
        described.append(
            {
                "directions": way.text,
                "reason": sentences.reason(audit, view, letters),
                "rank": view.rank,
                "position": sentences.point(pose[:3, 3]),
                "unit": audit.survey.unit,
                "ahead": sentences.point(pose[:3, 2]),
                "pictures": [
                    {"png": to_png(figure), "caption": caption}
                    for figure, caption in audit_figures.view_pictures(audit, view, way)
                ],
            }
        )
    return described
