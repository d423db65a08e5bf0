"""Constants shared by the formulas in plain JAX and the kernels."""

import numpy as np

ON_EDGE = 1e-6
"""Tangent coordinates within this of 0 lie on the edge of kappa's box, which belongs to it."""

CORNER = 0.6
"""Points at which visibility is tested, in voxels from a voxel's center along columns and rows."""

HALF_WIDTH = 0.51
"""Half the size of a voxel's footprint, in voxels, with a tolerance for rounding."""

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
"""Replaces infinite depth, so that differences stay finite [m]."""

STRAY = 0.01
"""Share of the depth by which a pixel may stray from the median around it: two or three sigma of
1 % noise."""

THIN = 0.06
"""Share of the depth that noise of 1 % never explains: steps beyond it are edges of thin parts."""

JOINED = 1 << 13
"""Chunk size of voxels that join the map. Frames rarely touch more; then they take several
chunks."""

MAX_PROBES = 192
"""Maximum number of probes before a key is dropped; at a load of 0.7 the expected longest search is
about 30."""

TILE = 16
"""Edge of a tile [px]."""

NEAR_PLANE = 0.01
"""Near plane: Gaussians with nearer centers are not drawn [m]."""

DILATION = 0.3
"""Added to the diagonal of every projected covariance [px^2], so that nothing is thinner than a
pixel (Kerbl et al. 2023)."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian whose alpha at a pixel is below this is skipped there."""

ALPHA_MAX = 0.99
"""Alpha is cut off here, so that the transmittance never reaches 0."""

TRANSMITTANCE_MIN = 1e-4
"""Compositing stops before the transmittance would fall to this."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian of the projection is taken at most this share of half the image outside it."""

SH0 = 0.28209479177387814
"""Factors of spherical harmonics of degree 0, and below of degree 1 to 3."""

SH1 = 0.4886025119029199
SH2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)

WINDOW_RADIUS = 5
"""The window of SSIM has 2 x 5 + 1 pixels a side."""

WINDOW_SIGMA = 1.5
"""Standard deviation of the window [px]."""

_exponents = -0.5 * (np.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1) / WINDOW_SIGMA) ** 2
TAPS = [float(w) for w in np.exp(_exponents) / np.exp(_exponents).sum()]
"""The window along a row or a column."""

SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""Stabilizers of SSIM for colors in [0, 1] (Wang et al. 2004)."""

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
"""Of Adam: decay of the moments of first and second order, and what keeps its step finite."""

SLACK_EDGES = 2.0
"""A measurement within this many edges of a voxel's center, along the axis, confirms the voxel."""

SLACK_NOISE = 0.03
"""The same, added as a share of the depth: three sigma of 1 % noise."""

HALF_DIAGONAL = 0.867
"""Half the diagonal of a voxel, in edges: its footprint in an image is within this."""

MOST_SAMPLES = 63
"""Pixels looked at along a side of a voxel's footprint; of wider ones every second, third, ..."""

LEAST_FOOTPRINT = 1.5
"""Smallest size of a voxel in an image [px]; smaller ones are too far away for a conclusion."""

NEAR_ENOUGH = 1.0 / 3.0
"""A frame counts against a voxel if its resolution is at least this share of the best one: thin
objects measured from nearby are not removed by distant frames, whose pixels miss them."""

FEW_OBSERVATIONS = 2
"""Voxels with at most this number of observations are removed sooner."""

MISSES_OF_FEW = 2
"""Looks through a voxel of few observations, without a confirmation between, that remove it."""

MISSES = 3
"""The same for a voxel of more observations."""

SWEEP_RADIUS = 3
"""Of the windows that a plane sweep compares [px]."""

LEAST_DEVIATION = 0.008
"""Windows whose brightness deviates by less (two of 255 steps) have no texture to compare."""

NO_SCORE = -1.0
"""Score of a comparison that cannot be made."""

LOG_ODDS_LIMIT = 4.5
"""Log-odds of the grid's cells are clipped to +- this, so that cells can change their state."""

STEP = 2.8
"""Log-odds step of an observation from distance 0."""

STEP_DECAY = 0.1
"""Decrease of the step per meter [1/m]."""

BLOCKS_ACROSS = 64
"""Blocks per image row: 8 pixels of a 512-pixel row, 9 cm at 5 m with 60 degrees of view."""

PASSED_OCTANTS = 4
"""A cell is passed if at least this number of its eight octants' centers were seen through."""
