"""r3jax: where to look next, so that 3D Gaussian splatting of a place comes out well.

An open implementation of R3-RECON (arXiv 2601.07484), written from the paper. A light voxel map
keeps what was seen, from where and how consistently; closed forms answer in milliseconds how well
any view could be rendered.

    m = r3jax.integrate(r3jax.empty_map(), frame)
    s = r3jax.renderability(m, camera, T_world_camera)

Where to look next, beside a robot or a SLAM system:

    planner = r3jax.start(camera, bounds)
    planner = r3jax.observe(planner, frame)
    decision, planner, info = r3jax.decide(planner, frame.T_world_camera, key)
"""

import lazy_loader

from r3jax.extras import naming_extras

# The names and their homes stand in `__init__.pyi`, where type checkers find them too. They load
# when first used, so that `r3jax --help` does not wait for JAX.
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Loads a public name; names the extra where it needs a package that is not installed."""
    with naming_extras():
        return _load(name)


__version__ = "0.1.0"
