"""The option of all commands that read a ROS bag."""

from dataclasses import dataclass
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """How a ROS bag is read."""

    topics: Annotated[str | None, tyro.conf.arg(metavar="NAMES")] = None
    """Topics and frames of a ROS bag, such as color=/cam/image_raw,pose=/odom; also depth, info,
    depth_info, frame, world. By default they are found."""
