"""Machine code: how kernels are compiled with Numba, and how XLA calls them."""
