"""Names of a bag's topics and frames, as a user gives them."""

import dataclasses
from dataclasses import dataclass


@dataclass(frozen=True)
class Topics:
    """Names of topics and frames; None is guessed."""

    color: str | None = None
    """Color images."""

    depth: str | None = None
    """Depth images."""

    info: str | None = None
    """Camera of the color images."""

    depth_info: str | None = None
    """Camera of the depth images."""

    pose: str | None = None
    """Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped in place of tf."""

    frame: str | None = None
    """Frame that the poses of `pose` are of; by default the message's child_frame_id, else the
    optical frame of the camera."""

    world: str | None = None
    """Frame of tf that poses are given in; by default the root, such as map."""


def parse_topics(text: str | None) -> Topics | None:
    """Reads names such as "color=/camera/color/image_raw,pose=/odom"; None stays None.

    Raises:
        ValueError: a word that is no such pair, or another key.
    """
    if text is None:
        return None
    known = [field.name for field in dataclasses.fields(Topics)]
    found: dict[str, str] = {}
    for word in filter(None, (word.strip() for word in text.split(","))):
        key, _, name = (part.strip() for part in word.partition("="))
        if key not in known or not name:
            raise ValueError(
                f"topics are named like color=/camera/color/image_raw,pose=/odom with "
                f"{', '.join(known)}; got {word!r}"
            )
        found[key] = name
    return Topics(**found)
