"""The ray caster: rays against triangles, and the colors of what they hit."""
