"""The part of the page that says what is wrong with single pictures, and shows them."""

import html

from r3jax.apps.audit.audit import Audit
from r3jax.apps.audit.faults.faults import Finding
from r3jax.apps.audit.pages.sentences import CONTRADICTED
from r3jax.apps.audit.pages.thumbnails import small_png
from r3jax.plots.page import image, section

_SHOWN = 8
"""Pictures of a finding that are shown."""

_SIDE = 230
"""Longer side of a picture on the page [px]."""

TITLES = {
    "blur": "Blurred by motion",
    "focus": "Out of focus",
    "brightness": "Brightness changes",
    "tint": "White balance changes",
    "pose": "Poses contradict the depth",
    "scale": "The scale of the depth is wrong",
    "ray": "Depth is measured along the ray",
    "camera": "The intrinsics of the camera are wrong",
    "repeat": "Pictures repeat each other",
    "stray": "Poses have diverged",
}
"""Heading of each kind of finding."""

_GRID = "display:grid;grid-template-columns:repeat(auto-fill,minmax(145px,1fr));gap:10px"
# A bag's frames are named by time stamps, longer than their thumbnails are wide.
_FIGURE = (
    '<figure style="margin:0">{}'
    '<figcaption style="font-size:13px;overflow-wrap:anywhere">{}</figcaption></figure>'
)


def faults_section(audit: Audit) -> str:
    """What is wrong with single pictures; says so where nothing is, or where nobody can tell."""
    faults = audit.faults
    body = "".join(_finding(audit, finding) for finding in faults.findings)
    if not faults.findings:
        body = f"<p>{_nothing_found(audit)}</p>" if faults.fits else ""
    if not faults.fits:
        body += f"<p>{html.escape(CONTRADICTED)}</p>"
    alone = faults.looked_at - faults.compared - len(faults.without_depth)
    if not faults.compared:
        body = "<p>Nobody can tell: no two pictures show the same surface.</p>"
    elif alone > 0 and faults.fits:
        body += (
            f"<p class=note>Nothing can be said of {alone} of the {faults.looked_at} pictures: no "
            "other one shows the same surface.</p>"
        )
    unsaid = sum(value is None for value in faults.record.get("detail", []))
    if unsaid > alone:
        body += (
            f"<p class=note>Nobody can tell whether {unsaid} of the {faults.looked_at} pictures "
            "are blurred: it takes two others of the same surface, from about the same side.</p>"
        )
    note = (
        "Pictures are compared block by block where two of them show the same surface, at most "
        "640 pixels wide; finer blur than a pixel of that does not show."
    )
    return section("What is wrong with the pictures", note, body)


def _nothing_found(audit: Audit) -> str:
    """What was looked for and not found; of the rest nothing is said."""
    record = audit.faults.record
    known = lambda name: any(value is not None for value in record.get(name, []))
    good = [
        word for word, name in (("sharp", "detail"), ("evenly lit", "brightness")) if known(name)
    ]
    if audit.source.is_dense and known("pose_off_by"):
        good.append("where they say")
    if not audit.source.has_images:
        return "None of them is there" + (", the depth images are where they say." if good else ".")
    if not good:
        return "Nothing can be said of them."
    listed = good[0] if len(good) == 1 else f"{', '.join(good[:-1])} and {good[-1]}"
    return f"Nothing was found: as far as they can be compared, they are {listed}."


def _finding(audit: Audit, finding: Finding) -> str:
    shown = list(zip(finding.frames, finding.captions, strict=True))[:_SHOWN]
    figures = "".join(
        _FIGURE.format(
            image(thumbnail(audit, index), audit.source.labels[index]),
            f"<b>{html.escape(audit.source.labels[index])}</b>: {html.escape(caption)}",
        )
        for index, caption in shown
    )
    more = finding.frames[_SHOWN:]
    names = ", ".join(html.escape(audit.source.labels[index]) for index in more)
    rest = f"<p class=note>And {len(more)} more: {names}.</p>" if more else ""
    return (
        f"<h3>{TITLES[finding.kind]}</h3><p class=why>{html.escape(finding.what)} "
        f"<b>Next time:</b> {html.escape(finding.todo)}</p>"
        f'<div style="{_GRID}">{figures}</div>{rest}'
    )


def thumbnail(audit: Audit, index: int) -> bytes:
    """A small PNG of an image of the capture, its upper edge up."""
    rgb, _ = audit.source.read(index)
    up = audit.survey.alignment.rotation.T @ [0.0, 0.0, 1.0]
    return small_png(rgb, audit.source.poses[index], up, _SIDE)
