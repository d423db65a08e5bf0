"""run.json: everything that fixes a run before its first view."""

import dataclasses
import importlib.metadata
import json
import platform
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from r3jax.errors import PathError
from r3jax.geometry.cameras import Camera
from r3jax.planning.policies import HOMES
from r3jax.planning.policy import LivesOutside, Policy
from r3jax.planning.robot.motion import Motion
from r3jax.scoring.config import function_name
from r3jax.validation.errors import ForeignFileError, VersionError, check_version
from r3jax.validation.files import check_relative, read_bytes
from r3jax.validation.images import MAX_PIXELS
from r3jax.validation.json_text import build, check_type, parse_json, sealed, unsealed

FORMAT = "r3jax-run"
"""Name of the format in run.json."""

VERSION = 3
"""Format version that this package writes. Versions 1 (without `parent`) and 2 (without `seal`) are
read, too."""

_MAX_BYTES = 16 << 20
"""Maximum size of run.json; settings take some kilobytes."""

_LENS = ("fx", "fy", "cx", "cy")

_PACKAGES = (
    "r3jax",
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "numba",
    "equinox",
    "orbax-checkpoint",
)


class RunError(PathError):
    """A run folder that cannot be read or written; names the file and the reason."""


@dataclass(frozen=True)
class RunHeader:
    """Settings, scene and software of a run."""

    scene: dict[str, Any]
    """`name` of the scene, `hash` of its content, and settings for opening it."""

    policy: dict[str, Any]
    """`name` and `settings`."""

    budget: str
    """For example `views:100`."""

    seed: int
    """Random seed."""

    config: dict[str, Any]
    """Settings of the loop: `exploration.config.ExplorationConfig`."""

    camera: dict[str, int | float]
    """`width`, `height`, `fx`, `fy`, `cx`, `cy` [px]."""

    bounds: list[list[float]]
    """Lower and upper corner of the scene's box [m], world."""

    packages: dict[str, str] = field(default_factory=dict[str, str])
    """Versions of the packages that shape the result, of Python, and the device."""

    parent: dict[str, Any] | None = None
    """Origin of a run made from others: `forked` from a run, `views` of it, the run's own policy
    from view `decided_from` on, and `decided_apart` if that run was merged or of a team; or
    `merged` runs with `merged_views` each; or the `team` of runs, folders side by side, in which
    this is number `member`, and that met every `meet_every` seconds."""

    @property
    def is_merged(self) -> bool:
        """True if the views come from several runs, each with its own map."""
        return self.parent is not None and "merged" in self.parent

    @property
    def is_of_team(self) -> bool:
        """True if the camera received frames of others."""
        return self.parent is not None and "team" in self.parent

    @property
    def intrinsics(self) -> Camera:
        """The camera of every frame."""
        # The size determines compiled shapes and is static; the rest is traced.
        size = {name: int(self.camera[name]) for name in ("width", "height")}
        return Camera(**size, **{name: self.camera[name] for name in _LENS})  # pyright: ignore[reportArgumentType]


def camera_fields(camera: Camera) -> dict[str, int | float]:
    """Returns a camera as plain numbers."""
    traced = {name: float(getattr(camera, name)) for name in _LENS}
    return {"width": camera.width, "height": camera.height, **traced}


def plain_settings(settings: Any) -> Any:
    """Converts nested settings (dataclasses, modules, arrays) to plain values for JSON."""
    if callable(settings):
        return function_name(settings)
    # vars, not asdict: that would copy arrays and stop at modules.
    if isinstance(settings, eqx.Module) or dataclasses.is_dataclass(settings):
        return {name: plain_settings(value) for name, value in vars(settings).items()}
    if isinstance(settings, str | bool | int | float | None):
        return settings
    if isinstance(settings, dict):
        return {str(name): plain_settings(value) for name, value in settings.items()}
    return np.asarray(settings).tolist()


def policy_fields(policy: Policy) -> dict[str, Any]:
    """Describes a policy for a header: its name, its settings, and the class of a plug-in."""
    fields = {"name": policy.name, "settings": settings_of(policy)}
    if policy.name not in HOMES and not isinstance(policy, LivesOutside):  # its class finds it
        fields["class"] = f"{type(policy).__module__}:{type(policy).__qualname__}"
    return fields


def settings_of(policy: object) -> dict[str, Any]:
    """Returns the settings of a policy that JSON can contain.

    Settings with the meaning of earlier versions are left out: the motion of a free-flying camera,
    no refinement, the paper's R, and a camera that turns by itself.
    """
    settings = plain_settings(getattr(policy, "config", {}))
    # Left out if it has no effect, so that earlier headers stay equal.
    if settings.get("motion") == plain_settings(Motion()):
        del settings["motion"]
    elif not settings.get("motion", {}).get("fixed_camera", True):
        del settings["motion"]["fixed_camera"]
    if settings.get("refine") == 0:
        del settings["refine"], settings["refine_radius"]
    if "scoring" in settings:
        plain = settings["scoring"].items()
        settings["scoring"] = {name: value for name, value in plain if value is not None}
    return settings


def package_versions() -> dict[str, str]:
    """Returns the versions of the packages and the machine that shape the result."""
    import jax  # only here is a device needed

    versions: dict[str, str] = {
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
    }
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # run from its source
            versions[name] = "not installed as a package"
    return versions


def header_to_json(header: RunHeader) -> str:
    """Writes the text of run.json."""
    # Format and version first, for human readers.
    plain = {"format": FORMAT, "version": VERSION, **dataclasses.asdict(header)}
    # `parse_json` refuses NaN: the run could never be read.
    return json.dumps(sealed(plain), indent=2, allow_nan=False) + "\n"


def read_header(path: Path) -> RunHeader:
    """Reads run.json.

    Raises:
        RunError: missing, not JSON, of another format or version, or with fields missing.
    """
    try:
        plain = parse_json(read_bytes(path, _MAX_BYTES))
    except FileNotFoundError:
        raise RunError(path, "the file is missing: this folder is not a run") from None
    except (OSError, ForeignFileError) as error:
        raise RunError(path, f"the file cannot be read ({error})") from None
    if not isinstance(plain, dict) or plain.get("format") != FORMAT:
        raise RunError(path, f"the file is not a run's (no format {FORMAT!r})")
    # Before the seal and the fields, which a newer version may have changed.
    try:
        check_version(plain.get("version"), VERSION)
    except VersionError as error:
        raise RunError(path, f"the run has {error}") from None
    try:
        fields = unsealed(plain)
        # They belong to the file, not to the run, and `build` refuses unknown fields.
        del fields["format"], fields["version"]
        header = build(RunHeader, fields)
        _check(header)
    except ValueError as error:
        raise RunError(path, f"a setting is missing or malformed ({error})") from None
    return header


def _check(header: RunHeader) -> None:
    """Refuses values that types do not exclude.

    Raises:
        ValueError: says which setting makes no sense.
    """
    # `camera`, `scene` and `policy` are dictionaries, of which `build` checks no names.
    for name, kind in (("width", int), ("height", int), *dict.fromkeys(_LENS, float).items()):
        check_type(f"camera.{name}", header.camera.get(name), kind)
    check_type("scene.name", header.scene.get("name"), str)
    check_type("policy.name", header.policy.get("name"), str)
    if header.is_of_team:
        _check_team(header.parent or {})
    camera = header.intrinsics
    # Sizes from a file become sizes of arrays: a damaged file must not exhaust memory.
    if camera.width * camera.height > MAX_PIXELS:
        raise ForeignFileError(f"images of {camera.width} x {camera.height} pixels are too large")
    if [len(corner) for corner in header.bounds] != [3, 3]:
        raise ForeignFileError("`bounds` must be two corners of three numbers")
    lower, upper = header.bounds
    if any(low > high for low, high in zip(lower, upper, strict=True)):
        raise ForeignFileError(f"`bounds` are upside down: {lower} to {upper}")


def _check_team(parent: dict[str, Any]) -> None:
    """Refuses invalid fields of a team.

    Raises:
        ValueError: says which setting makes no sense.
    """
    check_type("parent.team", parent["team"], list[str])
    check_type("parent.meet_every", parent.get("meet_every"), float)
    if not parent["team"] or parent["meet_every"] < 0.0:
        raise ForeignFileError(
            "`parent` describes a team without members, or with a negative interval"
        )
    # The others' runs are opened by these names: they may not lead out of the team's folder.
    for name in parent["team"]:
        check_relative(name)
