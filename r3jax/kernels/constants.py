"""Numbers that the formulas in plain JAX share with the kernels."""

ON_EDGE = 1e-6
"""Tangent coordinates within this of 0 lie on the edge of kappa's box, which belongs to it."""

CORNER = 0.6
"""Where visibility is tested, in edges from a voxel's center along columns and rows."""

HALF_WIDTH = 0.51
"""Half an edge, and a little for rounding: how far a voxel's footprint reaches from its center."""

NEAR = 0.25
"""The projection is linear in the position only nearly: added edges per edge / distance."""

SEAM = 0.6
"""Where a wall passes from one level of a pyramid to the next, pixel centers of the two do not
interlock. Voxels on the first fifth of a level therefore reach a quarter of a pixel farther: to the
centers of the finer pixels that theirs consist of."""

STRIDES = (1, 2, 4)
"""Steps over which the slope of a depth buffer is taken [px]. A voxel near by covers several pixels
at one distance, so that the slope from pixel to pixel is 0 on most of a tilted wall."""

MAX_STRETCH = 6.0
"""The allowance behind a surface grows at most by this: surfaces seen at 80 degrees from their
normal."""

FAR = 1e4
"""Stands for "nothing there", so that differences stay finite [m]."""

STRAY = 0.01
"""Share of the depth by which a pixel may stray from the median around it: two or three sigma of
1 % noise."""

THIN = 0.06
"""Share of the depth that noise of 1 % never explains: steps beyond it are edges of thin parts."""

JOINED = 1 << 13
"""Voxels that join the map at once. A frame rarely touches more; one that does takes turns."""

MAX_PROBES = 192
"""A key that finds no place within this many probes counts as dropped: at a load of 0.7 the
expected longest search is about 30."""
