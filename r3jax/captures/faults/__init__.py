"""What is wrong with single frames: blur, light, depth against poses, repetition."""
