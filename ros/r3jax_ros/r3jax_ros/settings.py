"""Parameters of the node; `config/r3jax.yaml` has the same with their defaults."""

from dataclasses import dataclass, field, fields
from typing import Any


@dataclass(frozen=True)
class Settings:
    """Lengths in meters, times in seconds, angles in degrees."""

    world_frame: str = "map"
    """Frame of poses, bounds and goals."""

    base_frame: str = "base_link"
    """Frame of the robot that Nav2 drives."""

    bounds: list[float] = field(default_factory=lambda: [-5.0, -5.0, 0.0, 5.0, 5.0, 2.5])
    """Box to explore in the world frame: lower and upper corner [m]; the floor is the lower z."""

    policy: str = "r3-pano"
    """Chooses the views: a name of `r3jax policies`."""

    candidates: int = 100
    """Views that are scored at each decision."""

    motion: str = "ground"
    """`ground`: wheels, the camera keeps height and tilt; `free`: it flies and looks anywhere."""

    footprint: list[float] = field(default_factory=lambda: [0.25])
    """Radius of a disk round base_frame [m], or corners x1 y1 x2 y2 ... of a polygon [m]."""

    height: float = 0.0
    """Height of the robot above the floor [m]; 0: that of its camera."""

    margin: float = 0.05
    """Distance that the footprint keeps from obstacles [m]."""

    max_range: float = 5.0
    """Range of the depth camera [m]."""

    frame_rate: float = 2.0
    """Most key frames in a second [Hz]."""

    stride: int = 2
    """Every n-th pixel of every n-th row is mapped."""

    map_rows: int = 1 << 18
    """Rows of the map at the start, a power of two; it grows."""

    remove_moved: bool = True
    """Remove what is seen through later, such as people who have walked on."""

    arrived: float = 0.3
    """A goal this near counts as reached [m]."""

    patience: float = 60.0
    """A goal that is not reached within this time is canceled [s]."""

    occupied_cost: int = 99
    """Cells of the costmap with at least this cost are no goals [0 to 100]."""

    trust_costmap: bool = False
    """Enter what the costmap holds for free, seen by the camera or not."""

    navigate_action: str = "navigate_to_pose"
    """Name of Nav2's action."""

    autostart: bool = True
    """Explore at once; otherwise from the service `start` on."""

    map_file: str = "r3jax_map"
    """Where the services `save` and `load` keep the planner."""

    page_port: int = 0
    """Port of a page that shows the progress; 0: none."""

    page_host: str = "127.0.0.1"
    """Address that the page listens on; 0.0.0.0 for other machines."""


def declared(node: Any) -> Settings:
    """Declares the parameters of a node and reads them."""
    default = Settings()
    read = lambda name: node.declare_parameter(name, getattr(default, name)).value
    return Settings(**{one.name: read(one.name) for one in fields(Settings)})
