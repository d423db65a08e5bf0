"""A fake of Habitat-Sim 0.3.3 that knows no more of it than was measured on the real one.

Attributes that are not listed raise AttributeError. What the real one ends the process for (a
CUDA device on a machine without; closing or collecting a simulator that is not the newest, and then
any use of the newer one) and what it does by default (sensors 1.5 m above the agent,
a buffer that it uses again) is imitated; pictures come from a function of the sensor's state.
"""

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

NOISE = (
    b"[00:00:01:000001]:[Error]:[Scene] SemanticScene.h(331)::checkFileExists : SSD Load Failure! "
    b"File /x.scn exists but failed to load.\n"
)
"""What the real one writes, of a file that is not there."""

Answer = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Position [3] and OpenGL axes [3, 3] of a sensor in Habitat's world to its pictures."""


def record(**defaults):
    """A class whose objects have these attributes, with these values, and no others."""

    def init(self):
        for name, value in defaults.items():
            object.__setattr__(self, name, value)

    def set_known(self, name, value):
        if name not in defaults:
            raise AttributeError(f"{type(self).__name__} has no {name}")
        object.__setattr__(self, name, value)

    return type("Record", (), {"__init__": init, "__setattr__": set_known})


class Degrees:
    """What `magnum.Deg` makes, and all that `hfov` takes."""

    def __init__(self, value: float) -> None:
        self.value = float(value)


class Quaternion:
    """What `quaternion.from_rotation_matrix` makes, and all that a rotation may be."""

    def __init__(self, matrix: np.ndarray) -> None:
        assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(matrix) > 0.0
        self.matrix = np.array(matrix)

    @property
    def wxyz(self) -> np.ndarray:
        return np.roll(Rotation.from_matrix(self.matrix).as_quat(), 1)


class FakeHabitat:
    """The three modules, and what they were asked."""

    def __init__(self, answer: Answer, *, has_cuda: bool = False) -> None:
        self._answer = answer
        self._has_cuda = has_cuda
        self.writes = NOISE
        """What it writes to the terminal at every start."""

        self.started: list[tuple[object, list[object]]] = []
        """Settings and sensors of every simulator that was started."""

        self.alive: list[int] = []
        """Numbers of the simulators whose graphics context exists, oldest first."""

        self.has_context = True
        """False once an older simulator was closed while a newer one was alive."""

        self.states: list[tuple[np.ndarray, np.ndarray]] = []
        """Position and rotation (w, x, y, z) of the agent at every picture."""

        self.modules = {
            "habitat_sim": SimpleNamespace(
                SimulatorConfiguration=record(scene_id="", gpu_device_id=0, enable_physics=True),
                CameraSensorSpec=record(
                    uuid="",
                    sensor_type=None,
                    sensor_subtype=None,
                    resolution=[128, 128],
                    hfov=Degrees(90.0),
                    position=[0.0, 1.5, 0.0],
                    clear_color=[0.0, 0.0, 0.0, 1.0],
                ),
                SensorType=SimpleNamespace(COLOR="color", DEPTH="depth"),
                SensorSubType=SimpleNamespace(PINHOLE="pinhole"),
                AgentState=record(position=np.zeros(3), rotation=None),
                agent=SimpleNamespace(
                    AgentConfiguration=record(sensor_specifications=[], action_space={"go": None})
                ),
                Configuration=lambda settings, agents: (settings, agents),
                Simulator=self._start,
            ),
            "magnum": SimpleNamespace(Deg=Degrees),
            "quaternion": SimpleNamespace(from_rotation_matrix=Quaternion),
        }

    def _start(self, configuration):
        settings, (agent,) = configuration
        if not Path(settings.scene_id).is_file():
            raise RuntimeError(f"there is no {settings.scene_id!r}")
        if settings.gpu_device_id != -1 and not self._has_cuda:
            raise SystemExit("the real one ends the process")
        assert settings.enable_physics is False
        assert agent.action_space == {}
        os.write(2, self.writes)
        self.started.append((settings, agent.sensor_specifications))
        return _Simulator(self, agent.sensor_specifications, self._answer, self.states)


class _Simulator:
    def __init__(self, library: FakeHabitat, sensors, answer: Answer, states) -> None:
        for sensor in sensors:
            assert sensor.sensor_subtype == "pinhole"
            assert isinstance(sensor.hfov, Degrees)
        self._sensors, self._answer, self._states = sensors, answer, states
        self._buffers: dict[str, np.ndarray] = {}
        # By number: a simulator in its library's list would never be collected.
        self._library, self._number = library, len(library.started)
        library.alive.append(self._number)

    def close(self, destroy: bool = True) -> None:
        if self._number in self._library.alive:
            self._library.has_context &= self._library.alive[-1] == self._number
            self._library.alive.remove(self._number)

    def __del__(self) -> None:
        self.close()

    def get_agent(self, index: int) -> SimpleNamespace:
        assert index == 0
        return SimpleNamespace(set_state=self._set_state)

    def _set_state(self, state) -> None:
        assert isinstance(state.rotation, Quaternion)
        self._states.append((np.asarray(state.position, float), state.rotation.wxyz))
        self._axes = state.rotation.matrix

    def get_sensor_observations(self) -> dict[str, np.ndarray]:
        if self._number not in self._library.alive or not self._library.has_context:
            raise SystemExit("the real one aborts: GL::Context::current(): no current context")
        for sensor in self._sensors:
            place = self._states[-1][0] + self._axes @ np.asarray(sensor.position, float)
            rgb, depth = self._answer(place, self._axes)
            assert list(depth.shape) == list(sensor.resolution)
            if sensor.sensor_type == "color":
                alpha = np.full((*rgb.shape[:2], 1), 255, np.uint8)
                fresh = np.concatenate([rgb, alpha], axis=2)
            else:
                fresh = depth.astype(np.float32)
            buffer = self._buffers.setdefault(sensor.uuid, np.empty_like(fresh))
            buffer[...] = fresh
        return self._buffers
