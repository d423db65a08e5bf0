"""Machine code: compiles kernels with Numba, and lets XLA call them."""
