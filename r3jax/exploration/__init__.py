"""The exploration loop: decide, move, render, map.

It uses worlds only as `simulators.base.Simulator`.
"""

import lazy_loader

# Lazy: budgets and settings are read without loading JAX.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submod_attrs={"loop": ["Result", "explore"]}
)
