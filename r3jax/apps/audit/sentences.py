"""Writes the sentences of an audit, for the page and the console."""

import shlex
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from r3jax.apps.audit.audit import SATURATED, Audit
from r3jax.apps.audit.diagnosis import FEW, FINE, NOT_KNOWN
from r3jax.apps.audit.suggest import DIRECTIONS, OVERLAP, Suggestion, promise, random_promise
from r3jax.captures.alignment import AXES
from r3jax.captures.survey import Survey

MEANING = {
    "fine": f"seen well enough: R ≥ {FINE:g} from where a person would stand",
    "angle": "seen, but only from other directions than those from which people would look at it",
    "rare": f"at most {FEW - 1} pictures show it, none of them from where people would look at it",
    "distance": "only seen from farther away than people would look at it",
    "noise": "its color differs between pictures: reflections, exposure or inaccurate poses",
    "unseen": "borders on free space, but no picture shows it",
    NOT_KNOWN: "no depth here: plain, dark or glossy surfaces, or seen from one side only",
}
"""Meaning of each cause, for the table."""

OF_PIXELS = {
    "fine": f"the other pictures show it well enough: R ≥ {FINE:g}",
    "unseen": "no other picture shows it, as far as the surfaces around it tell",
}
"""Meaning of causes without a depth camera, where they are shares of the pictures' pixels."""

REMEDY = {
    "fine": "",
    "angle": "take pictures from the missing sides",
    "rare": "take pictures from where people would look at it",
    "distance": "go nearer",
    "noise": "lock exposure and white balance, avoid reflections, check the poses",
    "unseen": "take a picture of it if it belongs to the scene",
    NOT_KNOWN: "take more overlapping pictures from more sides; plain walls need depth images",
}
"""Remedy of each cause, for the table."""

SHORT = {
    "angle": "only from other angles",
    "rare": "by one or two pictures only",
    "distance": "only from too far away",
    "noise": "in contradictory colors",
}
"""How a surface with each cause was seen, to complete "seen ..."."""

_DO = {
    "angle": "Go round",
    "rare": "Take more pictures",
    "distance": "Go nearer",
    "noise": "Keep the light even",
}
"""Remedy of each cause in a word or two."""

GOOD, _AGAIN = 0.85, 0.3
"""Shares seen well enough: above the first a capture is good for splats, below the second, a share
of what is known, it should be taken again. A white table is no fault of the pictures."""

_LEAST_PROMISE = 0.5
"""Minimum gain that is reported as a gain [percent]."""

_MOST = 0.5
"""Minimum share of pictures with a pose."""

_SEVERE = ("pose", "scale", "ray", "camera", "stray")
"""Faults that spoil a model even if everything is seen."""

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

_LEAST_TOLD, _THINGS = 0.03, 3
"""Minimum share of a cause to appear among the things to do, and the maximum number of these."""

_DEPTH_FROM = {
    "depth": "depth images",
    "stereo": "COLMAP's stereo, computed from the photos",
    "sweep": "multi-view stereo of the photos (plane sweep)",
    "model": "the trained splat",
    "tracks": "the sparse points matched in each picture",
    "cloud": "the visible points of the cloud",
}
"""Source of the surfaces."""

_MOST_SAID = 4
"""Maximum number of findings on single pictures in the summary."""

_DOUBTFUL = 5.0
"""An estimated vertical with a larger uncertainty is mentioned first [deg]."""

_COARSE, _VIEWED = 0.25, 10.0
"""Voxels that are coarse, and the range that is advised then [median depths]."""

_MOST_NAMED = 6
"""Maximum number of unreadable pictures named in a sentence."""

CONTRADICTED = (
    "Blur, exposure, white balance and single poses are not known: depth and cameras contradict "
    "each other, so pictures cannot be compared."
)
"""Remark on the pictures if depth and poses contradict each other."""

_ORDINARY = ("angle", "rare", "distance", "noise")


def length(audit: Audit, in_audit: float) -> str:
    """Writes a length of the audit in the capture's units."""
    return f"{audit.survey.length(in_audit):.3g} {audit.survey.unit}"


def area(audit: Audit, in_audit: float) -> str:
    """Writes an area of the audit in the capture's units, to two digits, as voxels are coarse."""
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
        "coordinates for the computation, and added back in all output files."
    )


def verdict(audit: Audit) -> list[str]:
    """Summarizes the audit, one sentence each."""
    sentences = [_surfaces(audit)]
    first = int(audit.survey.is_one_place)  # this one stays first
    if (audit.survey.up.within or 0.0) > _DOUBTFUL:
        sentences.insert(first, vertical(audit))
    sentences[first:first] = first_things(audit)
    if audit.survey.doubt is not None:
        sentences.insert(0, f"Warning: these results are unreliable: {audit.survey.doubt}")
    if audit.faults.findings:
        said = " ".join(finding.what for finding in audit.faults.findings[:_MOST_SAID])
        sentences.append(f"Problems of single pictures: {said}")
    if not audit.faults.fits:
        sentences.append(CONTRADICTED)
    if audit.is_object:
        sentences.append(
            "The cameras look inward at an object, so it is evaluated from the dome of cameras "
            "around it, not from where people could stand. If it stands against a wall, skip the "
            "views from behind that."
        )
    if audit.unseen:
        sentences.append(
            f"About {area(audit, audit.unseen_area)} bordering free space was never photographed."
        )
    return sentences if audit.survey.is_one_place else [*sentences, *_promises(audit)]


def first_things(audit: Audit) -> list[str]:
    """Lists remarks to show before the verdict: pictures and surfaces that were left out of it."""
    remark = audit.source.remark
    said = [*coarse(audit.survey), *unread(audit), *without_depth(audit)]
    return said if remark is None else [remark, *said]


def coarse(survey: Survey) -> list[str]:
    """Warns that what is near is a few voxels, where the pictures have a view into the distance."""
    voxel = survey.length(survey.voxel_size)
    if voxel < _COARSE * survey.median_depth:
        return []
    return [
        f"A voxel is {voxel:.2g} {survey.unit} wide, since some surfaces are "
        f"{survey.far_depth:.2g} {survey.unit} away, but half of all that is seen is within "
        f"{survey.median_depth:.2g} {survey.unit}: what is near is not judged. "
        f"--max-range {_VIEWED * survey.median_depth:.2g} judges it, and not the distance."
    ]


def _surfaces(audit: Audit) -> str:
    """Describes how much of the surface was seen well enough.

    This is not known if all pictures were taken from one place.
    """
    survey = audit.survey
    if survey.is_one_place:
        return (
            f"All pictures were taken from one place (within {survey.span:.2g} {survey.unit}, at a "
            f"median depth of {survey.median_depth:.2g} {survey.unit}): every surface was seen "
            "from one direction only, so how it would render from other places is not known. Take "
            "pictures from other places, a step apart."
        )
    shares = {cause: cause_share(audit, cause) for cause in _ORDINARY}
    ordered = sorted(shares, key=lambda cause: -shares[cause])
    parts = [f"{100 * shares[c]:.0f} % is seen {SHORT[c]}" for c in ordered if shares[c] >= 0.005]
    fine = f"{100 * cause_share(audit, 'fine'):.0f} %"
    if audit.source.is_complete:
        start = f"{fine} of {audit.places.seen_from} is"
    else:
        what = "pictures" if audit.is_own_path else "frames"
        start = (
            f"There is no depth camera: depth comes from {_DEPTH_FROM[audit.source.kind]}. "
            f"{fine} of the pixels of the {what} are"
        )
        if audit.shares["unseen"] >= 0.005:
            by = "no other picture" if audit.is_own_path else "no picture"
            parts.append(f"{100 * audit.shares['unseen']:.0f} % is shown by {by}")
        parts.append(f"{_unknown(audit)} is not known ({MEANING[NOT_KNOWN]})")
    well = f"R ≥ {FINE:g}" + ("" if audit.source.has_images else ", if colors agree")
    return f"{start} seen well enough ({well})" + (f"; {listed(parts)}." if parts else ".")


def _promises(audit: Audit) -> list[str]:
    """Describes how well the frames are covered, and the expected gain of further views."""
    sentences: list[str] = []
    mean = audit.mean_renderability
    worst = audit.frames[int(np.nanargmin(np.r_[audit.renderability, np.inf])) % len(audit.frames)]
    what = "What a picture shows" if audit.is_own_path else "What a frame of the path shows"
    by = "by the others" if audit.is_own_path else "by the pictures"
    beside = "" if audit.source.is_complete else ", where it is known"
    if np.isnan(worst.score.renderability):
        sentences.append(f"{what} is not known: no surface was found in any of its frames.")
    elif audit.is_saturated:
        sentences.append(f"{what} was seen {by} with R {mean:.2f} on average. {saturation()}")
    else:
        sentences.append(
            f"{what} was seen {by} with R {mean:.2f} on average{beside}; least of {worst.label}, "
            f"{worst.score.renderability:.2f}."
        )
    if audit.plan.views:
        sentences.append(promised(audit))
    return sentences


def promised(audit: Audit) -> str:
    """Describes the expected gain of the suggested pictures, and of as many at random places."""
    count = len(audit.plan.views)
    these = "This picture" if count == 1 else f"These {count} pictures"
    if not audit.source.is_complete:
        these = these[:1].lower() + these[1:]
        return f"How much {these} would add is not known without a depth camera."
    now = 100 * audit.diagnosis.fine_share
    low, middle, high = (100 * share for share in promise(audit.plan))
    if middle - now < _LEAST_PROMISE:
        what = "it" if count == 1 else "they"
        return f"More pictures hardly raise the {now:.0f} %: {what} would show unseen places."
    drawn = 100 * random_promise(audit.plan).middle
    verb, as_many = ("raises", "one") if count == 1 else ("raise", "as many")
    # New surfaces are new gaps: random pictures may open more than they close.
    random = f"to about {drawn:.0f} %" if drawn - now >= _LEAST_PROMISE else "hardly at all"
    return (
        f"{these} {verb} the {now:.0f} % to about {middle:.0f} % (in most simulated captures, to "
        f"between {low:.0f} and {high:.0f} %); {as_many} at random places {random}."
    )


def vertical(audit: Audit) -> str:
    """Describes which direction is up, and its uncertainty."""
    up = audit.survey.up
    if up.within is None:
        return f"Up is {_up_name(up.direction)} of the capture."
    from_what = "floors, walls and " if audit.source.is_dense else ""
    numbers = ",".join(f"{value:.2f}" for value in up.direction)
    return (
        f"Up was estimated to within {up.within:.0f} degrees: {_up_name(up.direction)} of the "
        f"capture, from {from_what}the cameras' orientation. If that is wrong, give the direction "
        f"(--up=z, or three numbers such as --up={numbers})."
    )


def unread(audit: Audit) -> list[str]:
    """Describes which pictures could not be read, and why: one sentence, or none."""
    left_out = audit.faults.left_out
    if not left_out:
        return []
    total = len(left_out) + audit.faults.looked_at
    named = "; ".join(list(left_out.values())[:_MOST_NAMED])
    more = len(left_out) - _MOST_NAMED
    rest = f"; and {more} more, named in audit.json" if more > 0 else ""
    verb = "was" if len(left_out) == 1 else "were"
    return [
        f"{len(left_out)} of the {total} pictures {verb} left out as unreadable ({named}{rest})."
    ]


def without_depth(audit: Audit) -> list[str]:
    """Describes how many pictures have no depth: one sentence, or none."""
    count = len(audit.faults.without_depth)
    if not count:
        return []
    what = "have no depth" if audit.source.is_complete else "show no point"
    return [
        f"{count} of the {audit.faults.looked_at} pictures {what}: they are left out, and the "
        "surfaces in them are not known."
    ]


def cause_share(audit: Audit, cause: str) -> float:
    """Returns the share of the evaluated surface with this cause, or `fine`.

    With a depth camera that is the surface visible from where people could stand; without one, the
    surface that the frames show, as points exist only where pictures saw them.
    """
    return audit.diagnosis.share(cause) if audit.source.is_complete else audit.shares[cause]


def saturation() -> str:
    """Explains the limit of R in a well-covered capture."""
    return (
        f"With a mean of {SATURATED:g} or more, the pictures cover each other well, and R cannot "
        "predict which of them renders better: for 250 pictures of a kitchen with a mean of 0.96, "
        "each held out once, the rank correlation of R and PSNR was 0.00. These pictures are "
        "therefore not ranked."
    )


def select_command(capture: Path | None) -> str:
    """Returns the command that keeps the fewest frames with nearly all of the quality."""
    return f"r3jax select {'CAPTURE' if capture is None else shlex.quote(str(capture))}"


def listed(parts: list[str]) -> str:
    """Joins words: a, b and c."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def reason(audit: Audit, view: Suggestion, letters: Iterable[str]) -> str:
    """Explains why a view is suggested."""
    face = audit.survey.voxel_size**2
    parts: list[str] = []
    total = sum(view.causes.values())
    if view.num_mended:
        parts.append(f"about {area(audit, view.num_mended * face)} would become seen well enough")
    if total:
        named = sorted(view.causes, key=lambda cause: -view.causes[cause])
        shares = [
            f"{100 * view.causes[c] / total:.0f} % {SHORT[c]}"
            for c in named
            if view.causes[c] >= 0.005 * total
        ]
        parts.append(f"it shows {area(audit, total * face)} seen too little: {', '.join(shares)}")
    if len(view.cells):
        cells = area(audit, len(view.cells) * audit.survey.cell_size**2)
        parts.append(f"it shows about {cells} that no picture shows")
    names = list(letters)
    if names:
        parts.append(f"regions {', '.join(names)}" if len(names) > 1 else f"region {names[0]}")
    return "; ".join(parts) or "it adds a direction to the surfaces in view"


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
        f"{survey.far_depth:.3g} {survey.unit}. Sizes that were not set are derived from these.",
        vertical(audit),
        "Renderability R (arXiv 2601.07484) of a surface from a position is bias × noise × "
        "resolution: the angle to the nearest direction from which it was seen, the consistency "
        "of its color, and the smallest distance from which it was seen.",
        f"Surfaces: every voxel is scored from those of {len(audit.standpoints)} standpoints, "
        "spread over the places near the pictures, that see it, with the most common camera; its "
        "score is the mean. Areas count one face of each voxel on the floor, walls, ceiling and "
        "all sides of furniture, so they are several times the floor area. With noisy depth, walls "
        "are several voxels thick, and areas are overestimated.",
        _standing(audit),
    ]
    pixels = (
        "; pixels without a voxel count as 0"
        if source.is_complete
        else " with a known surface (a voxel measured by at least two pictures) and those that "
        "no picture used can show, which count as 0"
    )
    if audit.is_own_path:
        count = len(audit.seen.folds)
        sentences.append(
            "Frames: the capture's own, each scored on a map without it and every "
            f"{_ordinal(count)} picture, like a model trained without these. R of a frame is the "
            f"mean over its pixels{pixels}."
        )
    else:
        sentences.append(
            "Frames: those of the path, scored on the map of all pictures. R of a frame is the "
            f"mean over its pixels{pixels}."
        )
    where = (
        f"where a camera was, or in free space, {length(audit, 0.3)} from everything else, "
        "connected to the camera's positions and at its heights"
        if source.is_dense
        else f"up to {length(audit, 0.3)} outside the hull of the camera's positions, "
        f"{length(audit, 0.3)} from every voxel, where a camera was or a ray to a point passed"
    )
    if audit.is_object:
        where = (
            "on the dome of cameras around the object, not below the lowest of them and "
            f"{length(audit, 0.3)} from every voxel"
        )
    num, searched = len(audit.places.eyes), audit.plan.num_searched
    which = f", of which the {searched} around which most is missing were searched"
    which = "" if searched == num else which
    sentences.append(
        f"Views: candidates are {num} positions {where}{which}, with {DIRECTIONS} directions each; "
        f"at least {100 * OVERLAP:.0f} % of a view must show known surfaces, so that the picture "
        "can be registered. The candidate that raises the mean renderability of "
        "all surfaces most is simulated before the next one is chosen. The expected gain is the "
        "simulated one, less the shortfall measured in embedded scenes in which the pictures were "
        "really taken (docs/results/audit.md)."
    )
    if (moved := origin(audit)) is not None:
        sentences.append(moved)
    if not source.is_metric:
        sentences.append("The scale of this capture is unknown; lengths are in its own units (u).")
    if not source.has_images:
        sentences.append("The images are missing, so noise is not known.")
    return sentences


def _standing(audit: Audit) -> str:
    """Describes whether a person can stand at the standpoints."""
    if not audit.places.is_checked:
        return (
            "It is not known whether a person could stand at these positions: the floor below the "
            "cameras was not seen, or no one walked there."
        )
    over = len(audit.places.eyes) - audit.places.num_standing
    return (
        "A person can stand at these positions: depth shows no obstacle between shin and head. "
        f"{over} more positions, which a camera reaches at arm's length, are also searched for "
        "views."
    )


def state(audit: Audit) -> str:
    """Returns the verdict in one word: `good` for splats, `gaps`, or start `again`."""
    survey, faults = audit.survey, audit.faults
    if survey.doubt is not None or survey.is_one_place or not faults.fits:
        return "again"
    fine = cause_share(audit, "fine")
    known = 1.0 if audit.source.is_complete else 1.0 - audit.shares[NOT_KNOWN]
    if fine < _AGAIN * known or _posed_share(audit) < _MOST:
        return "again"
    return "good" if fine >= GOOD and not _severe(audit) else "gaps"


def _severe(audit: Audit) -> list[str]:
    """Returns the headings of the faults that spoil a model regardless of coverage."""
    return [TITLES[f.kind] for f in audit.faults.findings if f.kind in _SEVERE]


def _posed_share(audit: Audit) -> float:
    """Returns the share of pictures for which structure from motion found a pose."""
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
    but = "".join(f" But {title[:1].lower()}{title[1:]}." for title in _severe(audit)[:1])
    if audit.source.is_complete:
        return f"{words}: {fine} of {audit.places.seen_from} is seen well enough.{but}"
    return (
        f"{words}: {fine} of the pictures' pixels are seen well enough, {_unknown(audit)} is not "
        f"known.{but}"
    )


def advice(audit: Audit) -> list[tuple[str, str]]:
    """Chooses up to three things to do, the most important first: heading and explanation."""
    survey, faults = audit.survey, audit.faults
    if survey.doubt is not None or not faults.fits:
        return [("Check the depth and the poses", survey.doubt or CONTRADICTED)]
    if survey.is_one_place:
        return [
            ("Take pictures from other places", "A step apart, around everything that matters.")
        ]
    looked = max(1, faults.looked_at)
    found = [
        (1.0 if f.kind in _SEVERE else len(f.frames) / looked, TITLES[f.kind], f.todo)
        for f in faults.findings
    ]
    found += _about_surfaces(audit)
    if not audit.source.is_complete and audit.shares[NOT_KNOWN] >= _LEAST_TOLD:
        unknown = f"{_unknown(audit)} is not known ({MEANING[NOT_KNOWN]})."
        found.append((audit.shares[NOT_KNOWN], "Let pictures overlap more", unknown))
    if audit.unseen:
        whole = float(audit.diagnosis.is_seen.sum()) * survey.voxel_size**2
        dark = (
            f"No picture shows about {area(audit, audit.unseen_area)} of walls, floor and "
            "furniture (dotted on the plan)."
        )
        share = audit.unseen_area / max(audit.unseen_area + whole, 1e-9)
        found.append((share, "Photograph the unseen places", dark))
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
        f"They show what was seen too little: of the surface {listed(seen)}."
        if seen
        else "They show the surfaces seen least well; few of the known ones need more views."
    )
    return [
        (
            1.0,
            "Take the picture below" if count == 1 else f"Take the {count} pictures below",
            f"{rest} {promised(audit)}",
        )
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
