"""Records of a benchmark that never ran: plausible numbers for tables and figures."""

import copy

import numpy as np

SKILL = {
    "random": 17.5, "frontier": 20.5, "cover": 21.0, "active-gamer": 22.0, "active-gs": 25.0,
    "r3": 26.0, "r3-pano": 26.3,
}  # fmt: skip
"""PSNR that a policy ends with [dB]."""


def record(
    policy="r3", scene="flat", seed=0, snapshot=30, *, budget=60, views=12, psnr=None, **changes
):
    """One record; `psnr` fixes the views' values, `changes` replace top-level fields."""
    digits = [ord(letter) for letter in f"{policy}{scene}{seed}{snapshot}"]
    rng = np.random.default_rng(digits)
    hard = np.random.default_rng([ord(letter) for letter in scene]).normal(0.0, 3.0, views)
    if psnr is None:
        center = SKILL[policy] + 4.0 * np.log2(snapshot / budget) + rng.normal(0.0, 0.4)
        psnr = np.clip(center + hard + rng.normal(0.0, 1.0, views), 4.0, 45.0)
    psnr = np.asarray(psnr, float)
    ssim = 1.0 - 1.2 * np.exp(-psnr / 12.0)
    pace = {"r3": 1.2, "r3-pano": 1.0}.get(policy, 1.6)
    fields = {
        "format": 1, "scene": scene, "scene_hash": f"hash of {scene}", "policy": policy,
        "settings": {}, "seed": seed, "budget": f"views:{budget}", "snapshot": f"views:{snapshot}",
        "clock": "model", "resolution": 256,
        "sensing": {
            "fov": 60.0, "noise": 0.01, "max_range": 5.0, "voxel_size": 0.05, "cell_size": 0.2,
        },
        "lpips_network": "alex",
        "training": {
            "iterations": 2000, "resolution": 128, "gaussians": 20000, "capacity": 40000,
            "strategy": "vanilla", "seed": seed,
        },
        "test_views": {"hash": f"views of {scene}", "count": len(psnr), "resolution": 128},
        "exploration": {
            "views": snapshot, "seconds": pace * snapshot * (1.0 + 0.1 * rng.random()),
            "metres": 0.4 * snapshot, "radians": 0.7 * snapshot, "known_share": 0.6,
            "mean_renderability": 0.5, "outcome": "budget",
        },
        "metrics": {},
        "views": {
            "view": list(range(len(psnr))), "psnr": psnr.tolist(),
            "psnr_measured": (psnr + 0.5).tolist(), "ssim": ssim.tolist(),
            "lpips": (0.9 - 0.8 * ssim).tolist(), "coverage": np.clip(psnr / 30, 0, 1).tolist(),
            "measured": [1.0] * len(psnr),
            "renderability": np.clip(psnr / 40 + rng.normal(0, 0.1, len(psnr)), 0, 1).tolist(),
        },
        "run": "runs/x", "machine": "two cores", "commit": "abc1234", "packages": {},
    }  # fmt: skip
    return copy.deepcopy(fields | changes)


def benchmark(
    policies=tuple(SKILL), scenes=("flat", "house"), seeds=(0, 1, 2), snapshots=(60,), **fields
):
    """All combinations."""
    return [
        record(policy, scene, seed, snapshot, **fields)
        for policy in policies
        for scene in scenes
        for seed in seeds
        for snapshot in snapshots
    ]
