"""What a recorded run was after, in hindsight, is what its policy weighed when it decided."""

import dataclasses
import shutil

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.frame import Frame
from r3jax.planning.registry import make_policy
from r3jax.runs.header import RunError, camera_fields, plain_settings
from r3jax.runs.reader import read_run
from r3jax.runs.replay import explain_run, rebuild, states_of
from r3jax.runs.settings import planner_config_of
from r3jax.runs.writer import RunWriter
from tests.exploration.toys import UPPER, BoxRoom
from tests.runs.runs import make_header

pytestmark = pytest.mark.full

VIEWS = 10
CONFIG = ExplorationConfig(voxel_size=0.1, capacity=1 << 14, clock="model", num_probes=1)


class GlassRoom(BoxRoom):
    """One wall is glass: what lies behind stays unexplored, until a planner gives it up."""

    def render(self, T_world_camera: np.ndarray) -> Frame:
        frame, camera = super().render(T_world_camera), self.camera
        u = (np.arange(camera.width) + 0.5 - float(camera.cx)) / float(camera.fx)
        v = (np.arange(camera.height) + 0.5 - float(camera.cy)) / float(camera.fy)
        along_x, depth = T_world_camera[0], np.asarray(frame.depth, np.float64)
        slope = along_x[0] * u[None, :] + along_x[1] * v[:, None] + along_x[2]
        is_glass = along_x[3] + slope * depth > UPPER[0] - 1e-3
        return eqx.tree_at(lambda f: f.depth, frame, jnp.where(is_glass, 0.0, frame.depth))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run of `r3`, whose trace tells U_G and U_R of every view."""
    path, room = tmp_path_factory.mktemp("hindsight") / "run", GlassRoom()
    settings = {"num_candidates": 12, "num_frontier": 4}
    policy = make_policy("r3", scoring=r3jax.ScoringConfig(lambda1=3.0), **settings)
    header = make_header(
        policy={"name": "r3", "settings": plain_settings(policy.config)},
        config=dataclasses.asdict(CONFIG),
        camera=camera_fields(room.camera),
        bounds=room.bounds.tolist(),
    )
    with RunWriter(path, header) as recorder:
        explore(room, policy, budget=f"views:{VIEWS}", config=CONFIG, recorder=recorder)
    return read_run(path)


@pytest.fixture(scope="module")
def states(run):
    return list(states_of(run))


def test_reasons_are_the_utilities_of_the_trace(run, states):
    """The unexplored cells and the sum of 1 - R are those that the trace says were weighed."""
    reasons = list(explain_run(run, states))
    assert len(reasons) == VIEWS
    assert reasons[0] is None
    for row, reason in zip(run.rows[1:], reasons[1:], strict=True):
        best = row.choice.top  # the first is the chosen one
        assert len(reason.cells) == best["exploration"][0]
        assert reason.totals[0] == 3.0 * best["exploration"][0]
        assert reason.totals[1:].sum() == pytest.approx(best["rendering"][0], rel=1e-5)
        assert reason.utility == pytest.approx(best["utility"][0], rel=1e-5)


def test_a_reason_holds_the_voxels_that_lack_something(run, states):
    for step, reason in enumerate(explain_run(run, states)):
        if reason is None:
            continue
        map_state, grid = states[step - 1].map_state, states[step - 1].grid
        assert reason.shares.shape == (3, len(reason.rows))
        assert np.asarray(map_state.occupied)[reason.rows].all()
        np.testing.assert_allclose(reason.shares.sum(axis=1), reason.totals[1:], rtol=1e-4)
        position = run.rows[step].pose[:3, 3]
        terms = r3jax.voxel_renderability(map_state, position, run.camera.focal)
        lack = 1.0 - np.asarray(terms.value)[reason.rows]
        np.testing.assert_allclose(reason.shares.sum(axis=0), lack, atol=1e-5)
        cells = np.floor((reason.cells - np.asarray(grid.origin)) / float(grid.cell_size))
        assert np.asarray(grid.unexplored)[tuple(cells.astype(int).T)].all()


def test_states_are_the_rebuilt_ones_and_are_made_when_asked_for(run, states):
    planner = rebuild([run], 3)
    np.testing.assert_array_equal(states[2].map_state.visited, planner.map_state.visited)
    np.testing.assert_array_equal(states[2].grid.log_odds, planner.grid.log_odds)
    asked = []

    def watched():
        for number, state in enumerate(states):
            asked.append(number)
            yield state

    reasons = explain_run(run, watched())
    assert next(reasons) is None
    assert asked == []
    next(reasons)
    assert asked == [0]
    list(reasons)
    assert asked == list(range(VIEWS - 1))  # nothing was decided on the last map


def test_settings_are_the_runs_own(run):
    config = planner_config_of(run)
    assert float(config.scoring.lambda1) == 3.0
    assert (config.num_candidates, config.num_frontier) == (12, 4)
    header = dataclasses.replace(run.header, policy={"name": "r3", "settings": {"novel": 1}})
    with pytest.raises(RunError, match="novel"):
        planner_config_of(dataclasses.replace(run, header=header))


def test_a_merged_run_is_refused(run):
    header = dataclasses.replace(run.header, parent={"merged": ["a", "b"], "merged_views": [2, 8]})
    with pytest.raises(RunError, match="merged"):
        next(explain_run(dataclasses.replace(run, header=header)))


def test_a_frame_that_is_missing_is_named(run, tmp_path):
    copy = shutil.copytree(run.path, tmp_path / "copy")
    (copy / "frames" / "000001.png").unlink()
    reasons = explain_run(read_run(copy))
    assert next(reasons) is None
    assert next(reasons) is not None
    with pytest.raises(RunError, match="missing"):
        next(reasons)
