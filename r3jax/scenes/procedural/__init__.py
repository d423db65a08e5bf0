"""Nine furnished scenes, made by code: fixed by name, the same on every run.

    from r3jax.scenes import procedural
    world = procedural.build("flat")

Every scene is closed (a camera inside sees surfaces only), has image-like textures, glossy and
mirror-like materials, windows on which depth sensors fail, and doorways that a robot of 0.3 m
radius passes.
"""
from r3jax.scenes.procedural.homes import flat
def build(name): return flat()
