"""The scenes, one file each: `build()` makes the world, `SUMMARY` describes it."""
