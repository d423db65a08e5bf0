"""The loop: decide, fly, look, remember. It knows worlds only as `simulators.base.Simulator`."""

import lazy_loader

# Budgets and settings are asked for where JAX shall not be waited for.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submod_attrs={"loop": ["Result", "explore"]}
)
