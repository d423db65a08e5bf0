"""How training is fast on a platform; each backend is held to the plain formulas."""
