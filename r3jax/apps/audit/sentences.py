"""The words of an audit, for the page and the console."""

from collections.abc import Iterable

import numpy as np

from r3jax.apps.audit.audit import SATURATED, Audit
from r3jax.apps.audit.diagnosis import FEW, FINE, NOT_KNOWN
from r3jax.apps.audit.suggest import DIRECTIONS, OVERLAP, Suggestion
from r3jax.captures.alignment import AXES

MEANING = {
    "fine": f"seen well enough: R of at least {FINE:g} from where people stand",
    "angle": "seen, but only from directions far from those in which one would look at it",
    "rare": f"only {FEW - 1} pictures or fewer show it, none of them from where one would look",
    "distance": "only seen from farther away than one would look at it",
    "noise": "its color differs from picture to picture: reflections, exposure, poses that are off",
    "unseen": "free space ends there in something that no picture shows",
    NOT_KNOWN: "no points here: plain, dark, glossy, or never seen from two sides",
}
"""Remedy of every cause, for the table."""

REMEDY = {
    "fine": "",
    "angle": "go round it: pictures from the missing sides",
    "rare": "take a picture of it from where people would look at it",
    "distance": "go nearer",
    "noise": "lock exposure and white balance; avoid reflections; check the poses",
    "unseen": "look into it, if it belongs to the place",
    NOT_KNOWN: "let pictures overlap more, from more sides; plain walls need depth images",
}
"""What one can do."""

SHORT = {
    "angle": "only from other angles",
    "rare": "too rarely",
    "distance": "only from too far away",
    "noise": "in contradictory colors",
}
"""How a surface was seen that suffers from a cause."""

_DO = {
    "angle": "Go round",
    "rare": "Take more pictures",
    "distance": "Go nearer",
    "noise": "Keep the light even",
}
"""What to do against a cause, in a word or two."""

GOOD, _AGAIN = 0.85, 0.3
"""Shares seen well enough: from the first on a capture is good for splats; below the second hardly
anything can be kept."""

_MOST = 0.5
"""Share of the pictures that must have a pose."""

_SEVERE = ("pose", "scale", "ray", "camera", "stray")
"""Faults that spoil a model, however much is seen."""

_LEAST_TOLD, _THINGS = 0.03, 3
"""Share from which on a cause is among the things to do; and how many of these there are."""

_DEPTH_FROM = {
    "depth": "depth images",
    "stereo": "COLMAP's stereo, computed from the photos",
    "sweep": "a comparison of the photos with each other (plane sweep)",
    "model": "the trained splat",
    "tracks": "the points whose tracks name the picture",
    "cloud": "the cloud's points that no nearer one hides",
}
"""Source of the surfaces."""

_MOST_SAID = 4
"""Findings on single pictures that the summary repeats."""

_DOUBTFUL = 5.0
"""A guess of the vertical that may be off by more is told first [deg]."""

_MOST_NAMED = 6
"""Pictures that cannot be read which a sentence names."""

CONTRADICTED = (
    "Blur, exposure, white balance and single poses are not known: depth and cameras contradict "
    "each other, so pictures cannot be compared."
)
"""What is said of the pictures where nothing fits."""

_ORDINARY = ("angle", "rare", "distance", "noise")


def length(audit: Audit, in_audit: float) -> str:
    """Writes a length of the audit in the capture's units."""
    return f"{audit.survey.length(in_audit):.3g} {audit.survey.unit}"


def area(audit: Audit, in_audit: float) -> str:
    """Writes an area of the audit in the capture's units, with two digits: voxels are no finer."""
    return f"{two_digits(in_audit * audit.survey.length(1.0) ** 2)} {audit.survey.unit}²"


def two_digits(value: float) -> str:
    """Writes a positive number with two significant digits: 0.012, 2.0, 76, 1200."""
    rounded = float(f"{value:.2g}")
    return f"{rounded:.0f}" if rounded >= 10.0 else f"{rounded:#.2g}"


def point(position: np.ndarray) -> str:
    """Writes coordinates for the reader."""
    return ", ".join(f"{value:.2f}" for value in position)


def origin(audit: Audit) -> str | None:
    """Names the point that was subtracted from a capture far from its origin, if any was."""
    subtracted = audit.survey.alignment.origin
    if not np.any(subtracted):
        return None
    return (
        f"The capture is far from its origin: ({point(subtracted)}) was subtracted from all "
        "coordinates before they were computed with, and added to all that are written."
    )


def verdict(audit: Audit) -> list[str]:
    """Summarizes the audit, one sentence each."""
    sentences = [_surfaces(audit)]
    first = int(audit.survey.is_one_place)  # nothing goes before that
    if (audit.survey.up.within or 0.0) > _DOUBTFUL:
        sentences.insert(first, vertical(audit))
    sentences[first:first] = [*unread(audit), *without_depth(audit)]
    if audit.source.remark is not None:
        sentences.insert(first, audit.source.remark)
    if audit.survey.doubt is not None:
        sentences.insert(0, f"Warning: these results are unreliable: {audit.survey.doubt}")
    if audit.faults.findings:
        said = " ".join(finding.what for finding in audit.faults.findings[:_MOST_SAID])
        sentences.append(f"The pictures themselves: {said}")
    if not audit.faults.fits:
        sentences.append(CONTRADICTED)
    if audit.is_object:
        sentences.append(
            "The cameras look inward at an object: it is judged from the dome of the cameras round "
            "it, not from where people could stand."
        )
    if audit.unseen:
        sentences.append(
            f"About {area(audit, audit.unseen_area)} bordering free space was never photographed."
        )
    return sentences if audit.survey.is_one_place else [*sentences, *_promises(audit)]


def first_things(audit: Audit) -> list[str]:
    """Lists what a reader must know before the verdict: pictures that are not in it."""
    remark = audit.source.remark
    return [*([] if remark is None else [remark]), *unread(audit), *without_depth(audit)]


def _surfaces(audit: Audit) -> str:
    """Says how much of the seen surface renders well.

    For pictures from one place, that is not known.
    """
    survey = audit.survey
    if survey.is_one_place:
        return (
            f"All pictures were taken from one place (within {survey.span:.2g} {survey.unit}; half "
            f"of what they show is {survey.median_depth:.2g} {survey.unit} away or more): every "
            "surface was seen from one direction only, and how it would render from elsewhere is "
            "not known. Take pictures from other places, a step apart."
        )
    shares = {cause: cause_share(audit, cause) for cause in _ORDINARY}
    ordered = sorted(shares, key=lambda cause: -shares[cause])
    parts = [f"{100 * shares[c]:.0f} % is seen {SHORT[c]}" for c in ordered if shares[c] >= 0.005]
    fine = f"{100 * cause_share(audit, 'fine'):.0f} %"
    if audit.source.is_complete:
        start = f"{fine} of the surface that a person sees from where one can stand"
    else:
        what = "pictures" if audit.is_own_path else "frames"
        start = (
            f"Without a depth camera, surfaces are known from {_DEPTH_FROM[audit.source.kind]}. "
            f"{fine} of what the {what} show"
        )
        parts.append(f"{_unknown(audit)} is not known ({MEANING[NOT_KNOWN]})")
    well = f"R ≥ {FINE:g}" + ("" if audit.source.has_images else ", if colors agree")
    return f"{start} is seen well enough ({well})" + (f"; {listed(parts)}." if parts else ".")


def _promises(audit: Audit) -> list[str]:
    """Says how the frames would render, and what further views would add."""
    found, plan = audit.diagnosis, audit.plan
    sentences: list[str] = []
    mean = audit.mean_renderability
    worst = audit.frames[int(np.nanargmin(np.r_[audit.renderability, np.inf])) % len(audit.frames)]
    what = (
        "From the other pictures alone, a picture" if audit.is_own_path else "A frame of the path"
    )
    beside = "" if audit.source.is_complete else ", where it is known"
    if audit.is_saturated:
        sentences.append(f"{what} renders with R {mean:.2f} on average. {saturation()}")
    else:
        sentences.append(
            f"{what} renders with R {mean:.2f} on average{beside}; the worst "
            f"({worst.label}) {worst.score.renderability:.2f}."
        )
    if plan.views:
        count = len(plan.views)
        views, drawn = (
            ("One further view", "one at a random place")
            if count == 1
            else (f"{count} further views", "as many at random places")
        )
        sentences.append(
            f"{views} would raise the mean over all surfaces"
            f"{'' if audit.source.is_complete else ' that are known'} from {found.mean:.2f} to "
            f"{plan.after.mean:.2f}, as far as it can be predicted; {drawn} "
            f"{plan.random_mean[-1]:.2f}."
        )
    return sentences


def vertical(audit: Audit) -> str:
    """Says which direction is up, and how certain that is."""
    up = audit.survey.up
    if up.within is None:
        return f"Up is {_up_name(up.direction)} of the capture."
    from_what = "floors, walls and " if audit.source.is_dense else ""
    numbers = ",".join(f"{value:.2f}" for value in up.direction)
    return (
        f"Up is a guess, within {up.within:.0f} degrees: {_up_name(up.direction)} of the capture, "
        f"from {from_what}how the cameras were held. Where another direction is up, give it "
        f"(--up=z, or three numbers such as --up={numbers})."
    )


def unread(audit: Audit) -> list[str]:
    """Says which pictures could not be read, and why: one sentence, or none."""
    left_out = audit.faults.left_out
    if not left_out:
        return []
    total = len(left_out) + audit.faults.looked_at
    named = "; ".join(list(left_out.values())[:_MOST_NAMED])
    more = len(left_out) - _MOST_NAMED
    rest = f"; and {more} more, named in audit.json" if more > 0 else ""
    verb = "is left out: it" if len(left_out) == 1 else "are left out: they"
    return [f"{len(left_out)} of the {total} pictures {verb} cannot be read ({named}{rest})."]


def without_depth(audit: Audit) -> list[str]:
    """Says how many pictures have no depth: one sentence, or none."""
    count = len(audit.faults.without_depth)
    if not count:
        return []
    what = "have no depth" if audit.source.is_complete else "show no point"
    return [
        f"{count} of the {audit.faults.looked_at} pictures {what}: they are left out, and what "
        "they show is not known."
    ]


def cause_share(audit: Audit, cause: str) -> float:
    """Returns the share of the evaluated surface with this cause, or `fine`.

    With a depth camera that is the surface visible from where people could stand; without one, the
    surface that the frames show, as points exist only where pictures saw them.
    """
    return audit.diagnosis.share(cause) if audit.source.is_complete else audit.shares[cause]


def saturation() -> str:
    """Explains what R cannot measure in a capture that is covered well."""
    return (
        f"With a mean of {SATURATED:g} or more, R says that these pictures show what others show "
        "well enough, and not which of them renders better: of a kitchen of 250 pictures with a "
        "mean of 0.96, each held out once, R and PSNR had a rank correlation of -0.00. So these "
        "pictures are not ranked; what is left to gain among them lies in the pictures themselves."
    )


def listed(parts: list[str]) -> str:
    """Joins words: a, b and c."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def reason(audit: Audit, view: Suggestion, letters: Iterable[str]) -> str:
    """Explains why a view is suggested."""
    face = audit.survey.voxel_size**2
    parts: list[str] = []
    total = sum(view.causes.values())
    if view.num_mended:
        parts.append(f"about {area(audit, view.num_mended * face)} is then seen well enough")
    if total:
        named = sorted(view.causes, key=lambda cause: -view.causes[cause])
        shares = [
            f"{100 * view.causes[c] / total:.0f} % {c}"
            for c in named
            if view.causes[c] >= 0.005 * total
        ]
        parts.append(
            f"of {area(audit, total * face)} in sight that is not yet: {', '.join(shares)}"
        )
    if len(view.cells):
        cells = area(audit, len(view.cells) * audit.survey.cell_size**2)
        parts.append(f"looks into about {cells} of what no picture shows")
    names = list(letters)
    if names:
        parts.append(f"regions {', '.join(names)}" if len(names) > 1 else f"region {names[0]}")
    return "; ".join(parts) or "adds a direction to what it shows"


def method(audit: Audit) -> list[str]:
    """Explains how the numbers were computed, in a sentence or two each."""
    survey, source = audit.survey, audit.source
    depth = _DEPTH_FROM[source.kind]
    sentences = [
        f"{len(survey.chosen)} of {len(source)} pictures, every {_ordinal(source.stride)} pixel "
        f"along rows and columns; depth from {depth}.",
        f"Voxels of {length(audit, survey.voxel_size)}, cells of free space of "
        f"{length(audit, survey.cell_size)}, visible up to {length(audit, 5.0)}; the depths have "
        f"the median {survey.median_depth:.3g} {survey.unit} and the 95th percentile "
        f"{survey.far_depth:.3g} {survey.unit}, and the sizes follow from them where they are not "
        "given.",
        vertical(audit),
        "Renderability R (arXiv 2601.07484) of a surface for a place to look from is bias × noise "
        "× resolution: the angle to the nearest direction it was seen from, the consistency of "
        "its color, and the best distance it was seen from.",
        f"Surfaces: every voxel is scored from those of {len(audit.standpoints)} "
        "standpoints that see it, with the camera of most pictures; its numbers are the means. "
        "Areas count one face of each voxel: floor, walls, ceiling and all sides of the furniture, "
        "so several times the floor; where depth is noisy, walls are several voxels thick, and "
        "areas too large by that.",
        _standing(audit),
    ]
    pixels = (
        "; one that shows no voxel counts 0"
        if source.is_complete
        else " that show a known surface: a voxel that two pictures or more have measured"
    )
    if audit.is_own_path:
        count = len(audit.seen.folds)
        sentences.append(
            f"Frames: the capture's own, each scored by a map without every {_ordinal(count)} "
            "picture, itself among them: what a model trained without these would have to invent. "
            f"R of a frame is the mean over its pixels{pixels}."
        )
    else:
        sentences.append(
            "Frames: the path's, scored by the map of all pictures. R of a frame is the mean over "
            f"its pixels{pixels}."
        )
    where = (
        f"in space known to be free, {length(audit, 0.3)} from everything else, connected to where "
        "the camera was and at its heights"
        if source.is_dense
        else f"within the hull of the camera's positions and {length(audit, 0.3)} round it, "
        f"{length(audit, 0.3)} from every voxel, where a camera was or a ray to a point passed"
    )
    if audit.is_object:
        where = (
            "on the dome of the cameras round the object that they look at, not below the lowest "
            f"of them and {length(audit, 0.3)} from every voxel"
        )
    sentences.append(
        f"Views: of {len(audit.places.eyes)} places {where}, {DIRECTIONS} directions each, those "
        f"of which {100 * OVERLAP:.0f} % or more show what is known (or a picture could not be "
        "registered); "
        "of all these the one that raises the renderability of all surfaces most is imagined as "
        "taken before the next one is chosen. Surfaces that were never seen, and "
        "colors, cannot be predicted."
    )
    if (moved := origin(audit)) is not None:
        sentences.append(moved)
    if not source.is_metric:
        sentences.append("The scale of this capture is unknown; lengths are in its own units (u).")
    if not source.has_images:
        sentences.append("The images are missing: nothing can be said about noise.")
    return sentences


def _standing(audit: Audit) -> str:
    """Says whether a person can stand where the audit looks from."""
    if not audit.places.is_checked:
        return (
            "Whether a person could stand at these places is not known: the floor below the "
            "cameras was not seen, or no one walked there."
        )
    over = len(audit.places.eyes) - audit.places.num_standing
    return (
        "A person can stand at these places: between the shin and the head nothing is in the way, "
        f"as far as depth shows. At {over} more places a camera can be held with an arm; views are "
        "looked for there, too."
    )


def state(audit: Audit) -> str:
    """Returns the verdict in one word: `good` for splats, `gaps`, or start `again`."""
    survey, faults = audit.survey, audit.faults
    if survey.doubt is not None or survey.is_one_place or not faults.fits:
        return "again"
    fine = cause_share(audit, "fine")
    if fine < _AGAIN or _posed_share(audit) < _MOST:
        return "again"
    severe = any(finding.kind in _SEVERE for finding in faults.findings)
    return "good" if fine >= GOOD and not severe else "gaps"


def _posed_share(audit: Audit) -> float:
    """Returns the share of the pictures that a structure from motion found a pose for."""
    model = audit.source.reconstruction
    return 1.0 if model is None else model.posed / max(model.pictures, 1)


def headline(audit: Audit) -> str:
    """Returns the verdict in one line."""
    words = {"good": "Good for splats", "gaps": "Gaps", "again": "Start again"}[state(audit)]
    if audit.survey.doubt is not None or not audit.faults.fits:
        return f"{words}: depth and cameras contradict each other."
    if audit.survey.is_one_place:
        return f"{words}: all pictures were taken from one place."
    model = audit.source.reconstruction
    if model is not None and _posed_share(audit) < _MOST:
        return f"{words}: only {model.posed} of {model.pictures} pictures have a pose."
    fine = f"{100 * cause_share(audit, 'fine'):.0f} %"
    if audit.source.is_complete:
        return (
            f"{words}: {fine} of what a person sees from where one can stand is seen well enough."
        )
    return (
        f"{words}: {fine} of what the pictures show is seen well enough; of {_unknown(audit)} "
        "nothing is known."
    )


def advice(audit: Audit, titles: dict[str, str]) -> list[tuple[str, str]]:
    """Chooses up to three things to do, the most important first: in bold, and the rest.

    Args:
        audit: what was found.
        titles: heading of each kind of finding.
    """
    survey, faults = audit.survey, audit.faults
    if survey.doubt is not None or not faults.fits:
        return [("Check the depth and the poses", survey.doubt or CONTRADICTED)]
    if survey.is_one_place:
        return [("Take pictures from other places", "A step apart, round all that matters.")]
    looked = max(1, faults.looked_at)
    found = [
        (1.0 if f.kind in _SEVERE else len(f.frames) / looked, titles[f.kind], f.todo)
        for f in faults.findings
    ]
    found += _about_surfaces(audit)
    if not audit.source.is_complete and audit.shares[NOT_KNOWN] >= _LEAST_TOLD:
        unknown = f"Of {_unknown(audit)} nothing is known: {MEANING[NOT_KNOWN]}."
        found.append((audit.shares[NOT_KNOWN], "Let pictures overlap more", unknown))
    if audit.unseen:
        whole = float(audit.diagnosis.is_seen.sum()) * survey.voxel_size**2
        dark = f"About {area(audit, audit.unseen_area)} that no picture shows (dotted on the plan)."
        share = audit.unseen_area / max(audit.unseen_area + whole, 1e-9)
        found.append((share, "Look into what is dark", dark))
    found.sort(key=lambda item: -item[0])
    return [(what, text) for _, what, text in found[:_THINGS]]


def _about_surfaces(audit: Audit) -> list[tuple[float, str, str]]:
    """Advises to take the suggested pictures, or else a remedy for each cause."""
    missing = {cause: cause_share(audit, cause) for cause in _ORDINARY}
    told = sorted((c for c in missing if missing[c] >= _LEAST_TOLD), key=lambda c: -missing[c])
    if not audit.plan.views:
        what = lambda c: f"{100 * missing[c]:.0f} % is seen {SHORT[c]}: {REMEDY[c]}."
        return [(missing[c], _DO[c], what(c)) for c in told]
    count = len(audit.plan.views)
    seen = [f"{100 * missing[cause]:.0f} % {SHORT[cause]}" for cause in told]
    rest = (
        f"What was seen {listed(seen)} is in sight there."
        if seen
        else "They look at what was seen least well; little is missing of what is known."
    )
    return [
        (1.0, "Take the picture below" if count == 1 else f"Take the {count} pictures below", rest)
    ]


def _unknown(audit: Audit) -> str:
    """Returns the share of the frames' pixels whose surface is not known."""
    return f"{100 * audit.shares[NOT_KNOWN]:.0f} %"


def region_letter(number: int) -> str:
    """Returns the letter of a region: A, B, ..."""
    return chr(ord("A") + number) if number < 26 else str(number + 1)


def _ordinal(count: int) -> str:
    if 10 <= count % 100 <= 20:
        return f"{count}th"
    return f"{count}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(count % 10, 'th') }"


def _up_name(up: np.ndarray) -> str:
    best = int(np.argmax(np.abs(up)))
    if abs(up[best]) > 0.9999:
        return ("-" if up[best] < 0.0 else "") + list(AXES)[best]
    return f"({point(up)})"
