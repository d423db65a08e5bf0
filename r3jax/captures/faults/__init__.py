"""Finds faults of single frames: blur, light, poses that contradict the depth, repetition."""
