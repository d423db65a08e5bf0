"""Machine code for CPUs: batched functions, under the names of the formulas that they repeat."""
