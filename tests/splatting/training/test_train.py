"""Training on a small scene whose truth is known."""

import dataclasses
import signal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.errors import TooLargeError, TrainingDiverged, ViewsError
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training import train_step as steps
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train import fit, scene_extent
from r3jax.splatting.views import Views
from tests.splatting.ball import NUM_VIEWS, ball_views, config
from tests.tiers import quick_and_full


@pytest.fixture(scope="module")
def views() -> Views:
    return ball_views()


def assert_same_bits(a, b) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.parametrize("strategy", quick_and_full(["vanilla", "mcmc"], ["vanilla"]))
def test_psnr_rises_within_the_capacity(views, strategy):
    settings = config(strategy=strategy, iterations=160, reset_every=1000, refine_until=100)
    seen = []
    result = fit(views, settings, on_progress=seen.append)
    psnr = result.history.psnr
    assert len(psnr) == 160
    assert psnr[-NUM_VIEWS:].mean() > psnr[:NUM_VIEWS].mean() + 4.0
    assert result.history.loss[-NUM_VIEWS:].mean() < 0.6 * result.history.loss[:NUM_VIEWS].mean()
    assert result.history.num_gaussians.max() <= 400
    assert result.history.num_gaussians[-1] > result.history.num_gaussians[0]
    assert [p.step for p in seen] == list(range(10, 161, 10))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(result.scene))
    assert not result.interrupted


def test_the_same_input_gives_the_same_bits_and_another_seed_others(views):
    first, second, other = (fit(views, config(seed=seed)) for seed in (1, 1, 2))
    assert_same_bits(first.scene, second.scene)
    np.testing.assert_array_equal(first.history.loss, second.history.loss)
    assert np.any(first.scene.means != other.scene.means)


@pytest.mark.full
@pytest.mark.parametrize("strategy", ["vanilla", "mcmc"])
def test_a_budget_that_is_too_small_costs_nothing_but_time(views, strategy):
    tight = RasterConfig(backend="numba", max_intersections=64)
    roomy = fit(views, config(strategy=strategy))
    found = fit(views, config(strategy=strategy, raster=tight))
    assert_same_bits(found.scene, roomy.scene)
    np.testing.assert_array_equal(found.history.loss, roomy.history.loss)


def test_an_overflown_step_changes_no_bit_and_says_what_it_needs(views):
    tight = config(raster=RasterConfig(backend="numba", max_intersections=64))
    state = steps.start_state(fit(views, config(iterations=1)).scene)
    before = jax.tree.map(jnp.copy, state)
    run = (views, jnp.asarray(2.0), tight, tight.schedule())
    after, info = steps.train_step(state, *run)
    assert int(info.outcome) == steps.OVERFLOWN
    assert int(info.num_intersections) > 64
    assert_same_bits(after, before)


def test_every_view_is_shown_once_an_epoch_and_epochs_differ():
    order = jax.jit(jax.vmap(lambda i: steps.view_index(config(), i, 5)))(jnp.arange(20))
    epochs = np.asarray(order).reshape(4, 5)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), np.tile(np.arange(5), (4, 1)))
    assert len({tuple(epoch) for epoch in epochs}) > 1


def test_higher_harmonics_wait_for_their_turn(views):
    early = fit(views, config(iterations=10, sh_every=10))
    assert not np.any(early.scene.sh[:, 1:])
    late = fit(views, config(iterations=12, sh_every=10))
    assert np.any(late.scene.sh[:, 1:])


@pytest.mark.full
def test_several_views_a_step_average_their_gradients(views):
    """A step of all views equals gradient descent on the mean loss: the order is irrelevant."""
    losses = [
        fit(views, config(iterations=1, views_per_step=NUM_VIEWS, seed=seed)) for seed in (0, 1)
    ]
    np.testing.assert_allclose(losses[0].history.loss, losses[1].history.loss, rtol=1e-5)
    singles = [
        fit(views.take(np.array([i, i])), config(iterations=1), scene=start(views)).history.loss[0]
        for i in range(NUM_VIEWS)
    ]
    whole = fit(views, config(iterations=1, views_per_step=NUM_VIEWS), scene=start(views))
    np.testing.assert_allclose(whole.history.loss[0], np.mean(singles), rtol=1e-4)


def start(views: Views) -> GaussianScene:
    from r3jax.splatting.training.initialize import initialize

    return initialize(views, 300, 400, 1)


def test_training_that_diverges_names_the_step_and_keeps_the_last_good_checkpoint(views, tmp_path):
    fit(views, config(iterations=20), folder=tmp_path / "good")
    scene = start(views)
    poisoned = eqx.tree_at(lambda s: s.means, scene, scene.means.at[7, 1].set(jnp.nan))
    with pytest.raises(TrainingDiverged, match="step 1"):
        fit(views, config(), scene=poisoned)
    wild = config(rate_means=3e38, rate_means_last=3e38, iterations=40)
    with pytest.raises(TrainingDiverged) as caught:
        fit(views, wild, folder=tmp_path / "wild", checkpoint_every=5)
    assert 1 <= caught.value.step <= 5
    assert not list((tmp_path / "wild").glob("0*"))  # nothing good was there to keep


def test_a_diverged_step_changes_no_bit(views):
    state = steps.start_state(start(views))
    moments = eqx.tree_at(lambda m: m.mean.means, state.moments, state.moments.mean.means + 1e-3)
    bad = state.scene.log_scales.at[3, 0].set(jnp.nan)
    state = eqx.tree_at(lambda s: (s.moments, s.scene.log_scales), state, (moments, bad))
    before = jax.tree.map(jnp.copy, state)
    after, info = steps.train_step(state, views, jnp.asarray(2.0), config(), config().schedule())
    assert int(info.outcome) == steps.DIVERGED
    assert_same_bits(after, before)


def test_a_sweep_over_rates_compiles_once(views):
    fit(views, config(rate_sh=1e-3))
    compiled = steps.train_step._cache_size()
    a = fit(views, config(rate_sh=2e-3, lambda_dssim=0.3))
    b = fit(views, config(rate_sh=5e-3, iterations=30, seed=5, gradient_threshold=1e-4))
    assert steps.train_step._cache_size() == compiled
    assert np.any(a.scene.sh != b.scene.sh)


def test_ctrl_c_ends_early_and_the_old_handler_is_back(views):
    def interrupt(progress):
        if progress.step == 20:
            signal.raise_signal(signal.SIGINT)

    result = fit(views, config(), on_progress=interrupt)
    assert result.interrupted
    assert len(result.history.loss) == 20
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.full
def test_backgrounds_differ(views):
    losses = [
        fit(views, config(iterations=1, background=name)).history.loss[0]
        for name in ("black", "white", "random")
    ]
    assert losses[0] < losses[2] < losses[1]  # the truth was rendered on black


def test_the_extent_is_that_of_3dgs_and_never_zero(views):
    centers = np.asarray(views.T_world_camera)[:, :3, 3]
    radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert scene_extent(views) == pytest.approx(1.1 * radius)
    turning = dataclasses.replace(
        views, T_world_camera=jnp.broadcast_to(views.T_world_camera[:1], (NUM_VIEWS, 4, 4))
    )
    depth = np.asarray(views.depth)
    assert scene_extent(turning) == pytest.approx(0.1 * np.median(depth[depth > 0.0]), rel=1e-6)


def test_what_cannot_be_trained_on_is_refused(views):
    with pytest.raises(ViewsError):
        fit(views.take(np.array([0])), config())
    with pytest.raises(TooLargeError, match="GB"):
        fit(views, config(capacity=1 << 34))
    with pytest.raises(ValueError, match=r"1.*2"):
        fit(views, config(sh_degree=2), scene=start(views))
    with pytest.raises(ValueError, match=r"400.*350"):
        fit(views, config(capacity=350), scene=start(views))
    with pytest.raises(ValueError, match="folder"):
        fit(views, config(), resume=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"iterations": 0}, "iterations"),
        ({"seed": -1}, "seed.*-1"),
        ({"seed": 1 << 31}, "seed.*2147483648"),
        ({"capacity": 10}, "300"),
        ({"strategy": "magic"}, "vanilla or mcmc"),
        ({"background": "green"}, "black, white or random"),
        ({"sh_degree": 4}, "0, 1, 2 or 3"),
        ({"rate_sh": float("nan")}, "rate_sh"),
        ({"rate_means": 0.0}, "must be positive"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        config(**changes)


def test_the_schedule_is_the_papers_and_short_runs_squeeze_it():
    assert TrainConfig().schedule() == (1000, 500, 15000, 100, 3000)
    assert TrainConfig(strategy="mcmc").schedule() == (1000, 500, 25000, 100, 3000)
    short = TrainConfig(iterations=1500).schedule()
    assert short == (150, 150, 750, 100, 3000)
    refined = [step for step in range(1501) if short.refines_after(step)]
    assert refined == [200, 300, 400, 500, 600, 700]
    assert not any(short.resets_after(step) for step in range(1501))
    paper = TrainConfig().schedule()
    assert [s for s in range(30001) if paper.resets_after(s)] == [3000, 6000, 9000, 12000]
