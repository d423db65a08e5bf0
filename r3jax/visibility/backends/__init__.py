"""How depth buffers are made fast on a platform; each is held to `visibility.reference`."""
