"""The nine scenes, one file each: `build()` makes the world, `SUMMARY` describes it."""
