"""Per-Gaussian record shared by the passes: 16 floats, one cache line.

Lengths are pixels. The conic is halved and in units of log 2, so that
alpha = 2^(LOG_OPACITY - (A dx^2 + B dx dy + C dy^2)). The slots from SLOPE on describe the ellipse
alpha = 1/255 column by column, see `passes.py`.
"""

SIZE = 16
"""Floats in a record."""

CENTER_X, CENTER_Y, A, B, C, LOG_OPACITY = 0, 1, 2, 3, 4, 5
RED, GREEN, BLUE, DEPTH = 6, 7, 8, 9

START, COUNT = 10, 11
"""int32: its intersections are START to START + COUNT; COUNT is 0 if it is not drawn."""

SLOPE, VARIANCE, INVERSE_XX, TWO_S = 12, 13, 14, 15
"""xy/xx and determinant/xx of the covariance, 1/xx, and 2 s where alpha is 1/255."""

GRADIENT_SIZE = 12
"""Floats in the gradient of one intersection: with v = alpha dL/dalpha, sums over its pixels of
v, v dx, v dx^2, v dy, v dx dy, v dy^2, then the gradients by color and depth, and two unused."""

VIEW_SIZE = 19
"""Floats that describe a view: rotation and translation of `T_camera_world` (9 + 3, row by row),
the camera's center in the world (3), fx, fy, cx, cy."""

BLOCK = 512
"""Gaussians that one thread takes at a time; partial sums are per block, so that they do not
depend on the number of threads."""
