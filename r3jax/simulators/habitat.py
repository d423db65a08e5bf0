"""Habitat-Sim 0.3.x as a simulator: its images instead of the ray caster's.

Habitat-Sim comes from conda or from source, never from the Python package index, so it is no extra;
`docs/howto/habitat.md` installs the two together. No display is needed, and no GPU.

A process holds one simulator of Habitat: a second one aborts it. Scenes with the same file, camera
and device share it; another one takes its place, and the first is loaded again (15 to 30 s) when it
renders next. `HabitatSimulator.close` frees its memory earlier.

Surfaces are shown in their stored colors, without lights. Three habits of Habitat matter here:
faces are seen from their front only; lines are drawn, which no ray meets; and a mesh without a
material (any PLY, so also Replica's) is shown dark and tinted by a default material, a mean of 84
of 255 off, though its depth is right. Of a PLY the colors are therefore the ray caster's, as
stored in the file; for Replica the ray caster alone (`replica:<name>`) shows the same faster.

Range and noise are ours, as those of the ray caster: depth beyond `max_range` is inf, and
`NoisySimulator` adds the noise. Where Habitat finds no surface its depth is 0, which is our
"no measurement" (the ray caster returns inf there, as nothing is there).

Our world is z-up with OpenCV camera axes. Habitat's is y-up with OpenGL camera axes (x right, y up,
z backward). Between the two lies the mesh file, whose axes are its maker's. `habitat_from_world`
always means the rotation [3, 3] from our world to Habitat's: neither moves the origin nor scales.
Measured on 0.3.3: a bare GLB is taken as z-up and turned, and a stage config
(`<name>.stage_config.json`) says by `up` and `front` which axes its GLB has. A PLY is never turned,
whatever its stage config says: of all 24 rotations the identity alone agreed.
"""

import contextlib
import copy
import ctypes
import hashlib
import math
import os
import subprocess
import sys
import warnings
import weakref
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.simulators.meshes import load_world, world_from_file
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular, read_bytes
from r3jax.validation.json_text import check_type, parse_json

_SAME_PLACE = 0.05
"""Depths of the mesh and of Habitat that differ by less show the same surface [m]."""

_MIN_AGREEMENT = 0.5
"""Least share of pixels that show the same surface; in the right world it is over 0.99."""


_NOISE = ("SSD Load Failure", r"\.scn exists but failed to load")
"""Lines that Habitat writes at every start, about a file that is not there and not needed."""


class HabitatSimulator:
    """RGB-D frames from Habitat-Sim, in the world of the `mesh:` scene of the same file.

    The box, the start and the free space round it come from the mesh file itself, so that a
    mission in Habitat starts where one in the ray caster does.
    """

    def __init__(
        self,
        scene: str | Path,
        camera: Camera | None = None,
        *,
        up: str | None = None,
        max_range: float | int | None = 5.0,
        start_pose: np.ndarray | None = None,
        seed: int = 0,
        gpu_device_id: int | None = None,
        mesh_colors: bool | None = None,
    ) -> None:
        """Loads the scene, into Habitat and for the start.

        Args:
            scene: a `.glb`, a `.ply` or a `.stage_config.json`.
            camera: intrinsics, square pixels and centered; None: 512x512 pixels, 60 degrees.
            up: vertical axis of the mesh file, "y" or "z"; None: y for glTF, z for PLY.
            max_range: z-depth beyond which the depth sensor sees nothing [m]; None: unlimited.
            start_pose: `T_world_camera` at the start; None: a search.
            seed: of the search for a start.
            gpu_device_id: CUDA device whose renderer is used, -1 for any; None: see
                `default_gpu_device`.
            mesh_colors: take the colors from the mesh file by ray casting, the depth alone from
                Habitat; None: for a PLY, whose vertex colors Habitat shows dark.

        Raises:
            ImportError: Habitat-Sim is not installed; says how to get it.
            ValueError: a camera that Habitat does not have, a file that it cannot show, settings
                out of range, or a start inside or too close to the mesh.
        """
        self._camera = Camera.from_fov(512, 512, 60.0) if camera is None else camera
        fov = horizontal_fov_deg(self._camera)
        stage = read_stage(scene)
        library = _import_habitat()
        self._habitat_from_world = stage.habitat_from_file @ world_from_file(stage.mesh, up).T
        self._mesh = RaycastSimulator(
            load_world(stage.mesh, up),
            self._camera,
            max_range=max_range,
            start_pose=start_pose,
            cull_back_faces=True,
            supersample=0,
            lighting=False,
            seed=seed,
        )
        self._mesh_colors = stage.is_ply if mesh_colors is None else mesh_colors
        lines = self._mesh.world.notes.get("lines")
        if lines is not None:
            warnings.warn(
                f"{stage.mesh} has {lines} meshes of lines: Habitat draws them, no ray meets them "
                "(mesh:<file> does not show them); take them out to compare the two",
                stacklevel=2,
            )
        self._max_depth = np.float32(np.inf if max_range is None else max_range)
        self._is_same_world = False
        if gpu_device_id is None:
            gpu_device_id = default_gpu_device()
        size = self._camera.height, self._camera.width
        self._habitat = _shared_habitat(library, stage.file, size, fov, gpu_device_id)

    def close(self) -> None:
        """Frees Habitat's memory and graphics context; the next render loads the scene again."""
        self._habitat.close()

    def with_camera(self, camera: Camera, *, max_range: float | int | None) -> "HabitatSimulator":
        """Returns a simulator of the same scene with another camera; it takes this one's place.

        Args:
            camera: square pixels and centered.
            max_range: as at the start [m].

        Raises:
            ValueError: a camera that Habitat does not have, or a range that is not positive.
        """
        other = copy.copy(self)
        other._camera = camera
        other._mesh = self._mesh.with_camera(camera, max_range=max_range)
        other._max_depth = np.float32(np.inf if max_range is None else max_range)
        other._habitat = self._habitat.resized(camera)
        return other

    @property
    def mesh(self) -> RaycastSimulator:
        """The ray caster of the mesh file: its surfaces, of which Habitat has no distances."""
        return self._mesh

    @property
    def camera(self) -> Camera:
        """Intrinsics of every frame."""
        return self._camera

    @property
    def bounds(self) -> np.ndarray:
        """Axis-aligned box of the mesh, [2, 3] [m]."""
        return self._mesh.bounds

    @property
    def start_pose(self) -> np.ndarray:
        """`T_world_camera` at the start, [4, 4] float64; searched for on first use.

        Raises:
            ValueError: no place has half a meter free all round, or Habitat shows another place
                there than the mesh file has, or not the faces of it that surround the start.
        """
        pose = self._mesh.start_pose
        if not self._is_same_world:
            self._check_same_world(pose)
            self._is_same_world = True
        return pose

    @property
    def content_hash(self) -> str:
        """SHA-256 of the content; it differs from that of the ray caster's scene."""
        who = "habitat, colors of the mesh" if self._mesh_colors else "habitat"
        return hashlib.sha256(f"{who} {self._mesh.world.content_hash}".encode()).hexdigest()

    def render(self, T_world_camera: np.ndarray | jax.Array) -> Frame:
        """Renders the RGB-D frame at a pose [4, 4].

        Depth is 0 where Habitat finds no surface, and inf beyond `max_range`.

        Raises:
            ValueError: the pose is not finite or not rigid.
        """
        T = np.asarray(T_world_camera, dtype=np.float64)
        image, depth = self._observe(T)
        depth = np.where(depth <= self._max_depth, depth, np.float32(np.inf))
        rgb = jnp.asarray(image.astype(np.float32) / np.float32(255.0))
        return Frame(
            rgb=self._mesh.render(T).rgb if self._mesh_colors else rgb,
            depth=jnp.asarray(depth),
            T_world_camera=jnp.asarray(T.astype(np.float32)),
            camera=self._camera,
            far=True,
        )

    def _observe(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Renders bytes [H, W, 3] and depth without limit [H, W] at a pose [4, 4]."""
        try:
            position, rotation = agent_from_pose(T, self._habitat_from_world)
        except ValueError as error:
            raise InputError(f"cannot render: {error}") from None
        return self._habitat.observe(position, rotation.as_matrix())

    def _check_same_world(self, pose: np.ndarray) -> None:
        """Refuses a Habitat that shows something else than the mesh file has from `pose` [4, 4]."""
        found = self._observe(pose)[1]
        agreement = self._agreement(found, pose, cull_back_faces=True)
        if agreement < _MIN_AGREEMENT:
            raise InputError(
                f"Habitat and the mesh file agree on {agreement:.0%} of the start's view: "
                "Habitat shows another world, or the same turned. Do up and front in the stage "
                "config name the axes of a GLB (a PLY is never turned), and do the faces have "
                "their front inside the rooms?"
            )
        agreement = self._agreement(found, pose, cull_back_faces=False)
        if agreement < _MIN_AGREEMENT:
            raise InputError(
                f"Habitat shows {agreement:.0%} of the surfaces around the start: it draws faces "
                "from their front only, and here most fronts face outward. Flip the normals of "
                "the mesh, or use the ray caster, which sees both sides: mesh:<file>"
            )

    def _agreement(self, found: np.ndarray, pose: np.ndarray, *, cull_back_faces: bool) -> float:
        """Computes the share of surface pixels in which Habitat's depth [H, W] is the mesh's."""
        mesh = self._mesh.with_camera(self._camera, max_range=None, cull_back_faces=cull_back_faces)
        known = np.asarray(mesh.render(pose).depth)
        known = np.where(np.isfinite(known), known, np.float32(0.0))
        is_seen = (known > 0.0) | (found > 0.0)
        is_same = np.abs(found - known)[is_seen] < _SAME_PLACE
        return float(is_same.mean()) if is_same.size else 1.0


def _shared_habitat(
    library: tuple[Any, Any, Any], file: Path, size: tuple[int, int], fov: float, gpu: int
) -> "_Habitat":
    """Opens the simulator of a scene, camera and device, or reuses the open one."""
    key = file, size, fov, gpu
    habitat = _SHARED.get(key)
    if habitat is None:
        habitat = _SHARED[key] = _Habitat(library, file, size, fov, gpu)
    habitat.open()
    return habitat


class _Habitat:
    """One scene in Habitat-Sim: an agent with two sensors in its origin."""

    _current: ClassVar["weakref.ref[_Habitat] | None"] = None
    """The only one of the process that is open: two graphics contexts end it."""

    def __init__(
        self,
        library: tuple[Any, Any, Any],
        file: Path,
        size: tuple[int, int],
        fov: float,
        gpu: int,
    ) -> None:
        """Notes a scene's file, the images' (height, width) and horizontal field of view [deg]."""
        self._library, self._settings = library, (file, size, fov, gpu)
        self._simulator: Any = None

    def resized(self, camera: Camera) -> "_Habitat":
        """Opens the same scene for another camera."""
        file, _, _, gpu = self._settings
        size, fov = (camera.height, camera.width), horizontal_fov_deg(camera)
        return _shared_habitat(self._library, file, size, fov, gpu)

    def close(self) -> None:
        """Ends the simulator, if it is open."""
        if self._simulator is not None:
            self._simulator.close(destroy=True)
            self._simulator = None

    def open(self) -> None:
        """Starts the simulator unless it is open, after closing the process's other one."""
        if self._simulator is not None:
            return
        other = None if _Habitat._current is None else _Habitat._current()
        if other is not None:
            other.close()
        habitat_sim, magnum, _ = self._library
        file, size, fov, gpu = self._settings
        settings = habitat_sim.SimulatorConfiguration()
        settings.scene_id = str(file)
        settings.gpu_device_id = gpu
        settings.enable_physics = False
        sensors: list[Any] = []
        kinds = {"rgb": habitat_sim.SensorType.COLOR, "depth": habitat_sim.SensorType.DEPTH}
        for name, kind in kinds.items():
            sensor = habitat_sim.CameraSensorSpec()
            sensor.uuid = name
            sensor.sensor_type = kind
            sensor.sensor_subtype = habitat_sim.SensorSubType.PINHOLE
            sensor.resolution = list(size)
            sensor.hfov = magnum.Deg(fov)
            sensor.position = [0.0, 0.0, 0.0]  # by default 1.5 m above the agent
            sensors.append(sensor)
        agent = habitat_sim.agent.AgentConfiguration()
        agent.sensor_specifications = sensors
        agent.action_space = {}
        with _without_noise():
            self._simulator = habitat_sim.Simulator(habitat_sim.Configuration(settings, [agent]))
        _Habitat._current = weakref.ref(self)

    def observe(self, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Renders colors [H, W, 3] uint8 and z-depth [H, W] float32 at a place in Habitat's world.

        The arrays may be Habitat's own: the next call may change them.

        Args:
            position: of the camera [3] [m].
            rotation: its OpenGL axes in Habitat's world, [3, 3].
        """
        self.open()
        habitat_sim, _, quaternion = self._library
        state = habitat_sim.AgentState()
        state.position = position
        state.rotation = quaternion.from_rotation_matrix(rotation)
        self._simulator.get_agent(0).set_state(state)
        seen = self._simulator.get_sensor_observations()
        return np.asarray(seen["rgb"])[..., :3], np.asarray(seen["depth"], np.float32)


_SHARED: weakref.WeakValueDictionary[tuple[Path, tuple[int, int], float, int], _Habitat] = (
    weakref.WeakValueDictionary()
)
"""Simulators by file, image size, field of view and device; one ends with its last user."""


@contextlib.contextmanager
def _without_noise() -> Generator[None]:
    """Keeps the lines of `_NOISE` from the terminal; everything else arrives there.

    Habitat writes from C++, to the descriptor, and may end the process: so it is another process
    that passes the rest on, however this one ends.
    """
    sys.stderr.flush()
    terminal = os.dup(2)
    patterns = [word for pattern in _NOISE for word in ("-e", pattern)]
    passer = ["grep", "--line-buffered", "-a", "-v", *patterns]
    try:
        with subprocess.Popen(passer, stdin=subprocess.PIPE, stdout=terminal) as process:
            assert process.stdin is not None
            os.dup2(process.stdin.fileno(), 2)
            try:
                yield
            finally:
                sys.stderr.flush()
                os.dup2(terminal, 2)  # it closes the other end: the process comes to its end
    finally:
        os.close(terminal)


def default_gpu_device() -> int:
    """Returns the `gpu_device_id` for this machine: 0 with CUDA, otherwise -1.

    Habitat-Sim ends the whole process if EGL does not have the given CUDA device, so none is
    tried. The CUDA driver reports the number of devices without starting one, and NVIDIA's EGL
    must be installed (containers often have CUDA alone). -1 takes the first renderer that EGL
    offers, which may run on a CPU.
    """
    try:
        driver = ctypes.CDLL("libcuda.so.1")
        ctypes.CDLL("libEGL_nvidia.so.0")
    except OSError:
        return -1
    count = ctypes.c_int(0)
    if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return -1
    return 0 if count.value > 0 else -1


def _import_habitat() -> tuple[Any, Any, Any]:
    """Imports `habitat_sim`, and the modules `magnum` and `quaternion` that come with it."""
    for name in ("MAGNUM_LOG", "HABITAT_SIM_LOG"):
        os.environ.setdefault(name, "quiet")  # read once, on import
    try:
        import habitat_sim  # pyright: ignore[reportMissingImports]
        import magnum  # pyright: ignore[reportMissingImports]
        import quaternion  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            f"Habitat-Sim cannot be imported ({error}). It is not on the Python package index: "
            "conda install habitat-sim headless -c conda-forge -c aihabitat, then install r3jax in "
            "that environment (docs/howto/habitat.md); or use the ray caster, which needs nothing: "
            "mesh:<file>, replica:<name>"
        ) from error
    return habitat_sim, magnum, quaternion


_CONFIG = ".stage_config.json"
_PLY = ".ply"
_MAX_CONFIG = 1 << 20
"""HabitatStage configs have a few hundred bytes."""

_UNMOVED: dict[str, Any] = {"scale": [1, 1, 1], "origin": [0, 0, 0], "units_to_meters": 1}
"""What else could move or scale the mesh, and the only values that are understood."""


@dataclass(frozen=True)
class HabitatStage:
    """A scene for Habitat."""

    file: Path
    """File that Habitat loads."""

    mesh: Path
    """Mesh that it shows: the same file, except for a stage config."""

    habitat_from_file: np.ndarray
    """Rotation [3, 3] from the mesh file's axes to Habitat's world."""

    @property
    def is_ply(self) -> bool:
        """True if the mesh is a PLY."""
        return self.mesh.suffix.lower() == _PLY


def read_stage(path: str | Path) -> HabitatStage:
    """Finds out what Habitat will show.

    Args:
        path: a `.glb`, a `.ply`, or a `.stage_config.json`.

    Raises:
        ValueError: another kind of file, one that is missing, or a stage config that does not say
            which mesh it shows and how it is turned.
    """
    path = Path(path).absolute()
    try:
        if path.name.lower().endswith(_CONFIG):
            return _read_config(path)
        turn = {".glb": BARE_GLB, _PLY: np.eye(3)}.get(path.suffix.lower())
        if turn is None:
            raise ForeignFileError(f"Habitat scenes are .glb, .ply or {_CONFIG} files")
        check_regular(path)
    except FileNotFoundError:
        raise InputError(f"no such file for Habitat: {path}") from None
    except (ForeignFileError, OSError) as error:
        raise InputError(f"{path}: {error!s:.500}") from error
    return HabitatStage(path, path, turn)


def _read_config(path: Path) -> HabitatStage:
    """Reads a stage config's mesh and axes."""
    config = parse_json(read_bytes(path, _MAX_CONFIG))
    check_type("the stage config", config, dict[str, Any])
    if "render_asset" not in config:
        raise ForeignFileError("it names no render_asset, so there is nothing to see")
    check_type("render_asset", config["render_asset"], str)
    for name, value in _UNMOVED.items():
        if config.get(name, value) != value:
            raise ForeignFileError(
                f"{name} {config[name]!s:.60} is not supported, only {value}: apply it to the mesh"
            )
    mesh = (path.parent / config["render_asset"]).absolute()
    try:
        check_regular(mesh)
    except FileNotFoundError:
        raise ForeignFileError(f"its render_asset {mesh} is missing") from None
    except ForeignFileError as error:
        raise ForeignFileError(f"its render_asset {mesh}: {error}") from None
    return HabitatStage(path, mesh, np.eye(3) if mesh.suffix.lower() == _PLY else _axes_of(config))


def _axes_of(config: dict[str, Any]) -> np.ndarray:
    """Computes the rotation [3, 3] for the `up` and `front` of a stage config."""
    lacking = [name for name in ("up", "front") if name not in config]
    if lacking:
        raise ForeignFileError(
            f"it does not say {' and '.join(lacking)}; give the mesh's own axes, for z up "
            '"up": [0, 0, 1], "front": [0, 1, 0], for y up "up": [0, 1, 0], "front": [0, 0, -1]'
        )
    for name in ("up", "front"):
        check_type(name, config[name], list[float])
    try:
        return habitat_from_axes(config["up"], config["front"])
    except ValueError as error:
        raise ForeignFileError(str(error)) from None


_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Between the camera's axes; its own inverse."""

_MAX_OFF_CENTER = 1e-3
"""How far the principal point may lie from the image's center [px]."""

_MAX_STRETCH = 1e-5
"""How much the focal lengths may differ, relative to their size."""


def habitat_from_axes(up: Sequence[float | int], front: Sequence[float | int]) -> np.ndarray:
    """Computes the rotation [3, 3] from a mesh file to Habitat's world.

    Args:
        up: direction in the file that becomes Habitat's up, +y; a stage config's `up`.
        front: direction in the file that becomes Habitat's front, -z; its `front`.

    Raises:
        ValueError: the directions are not axes of unit length at right angles.
    """
    y, z = np.asarray(up, np.float64), -np.asarray(front, np.float64)
    if y.shape != (3,) or z.shape != (3,):
        raise InputError(f"up and front are 3 numbers each, got {y.size} and {z.size}")
    with np.errstate(all="ignore"):  # numbers of any size may stand in a file
        rotation = np.stack([np.cross(y, z), y, z])
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not error <= 1e-6:
        raise InputError(
            f"up {list(up)} and front {list(front)} must have unit length and be at right angles"
        )
    return rotation


BARE_GLB = habitat_from_axes((0, 0, 1), (0, 1, 0))
"""What Habitat does with a GLB that no stage config describes: (x, y, z) -> (x, z, -y)."""


def agent_from_pose(
    T_world_camera: np.ndarray, habitat_from_world: np.ndarray
) -> tuple[np.ndarray, Rotation]:
    """Computes the state of an agent whose camera sits in its origin.

    Args:
        T_world_camera: pose of the camera in our world, [4, 4].
        habitat_from_world: rotation [3, 3].

    Returns:
        Position in Habitat's world [3] [m], and rotation: exact where the pose is rigid up to
        rounding only.

    Raises:
        ValueError: the pose is not finite or not rigid.
    """
    problem = rigid_error(T_world_camera)
    if problem is not None:
        raise InputError(problem)
    T = np.asarray(T_world_camera, np.float64)
    rotation = habitat_from_world @ T[:3, :3] @ _OPENGL_FROM_OPENCV
    return habitat_from_world @ T[:3, 3], Rotation.from_matrix(rotation)


def horizontal_fov_deg(camera: Camera) -> float:
    """Computes the horizontal field of view [deg] that defines a camera in Habitat.

    Raises:
        ValueError: Habitat cannot show this camera's image: its pixels are not square, or the
            principal point is not the image's center.
    """
    fx, fy, cx, cy = (float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    if abs(fx - fy) > _MAX_STRETCH * fx:
        raise InputError(
            f"Habitat's cameras have square pixels, but fx is {fx:.6g} and fy {fy:.6g} px: give "
            "a camera with fx = fy (Camera.from_fov), or use the ray caster (mesh:<file>)"
        )
    center = 0.5 * camera.width, 0.5 * camera.height
    if max(abs(cx - center[0]), abs(cy - center[1])) > _MAX_OFF_CENTER:
        raise InputError(
            f"Habitat's cameras look through the image's center {center}, but the principal point "
            f"is ({cx:.6g}, {cy:.6g}) px: give a centered camera (Camera.from_fov), or use the "
            "ray caster (mesh:<file>)"
        )
    return math.degrees(2.0 * math.atan(0.5 * camera.width / fx))
