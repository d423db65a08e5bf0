"""Machine code for CPUs: formulas of other packages again, as batched functions of arrays.

`calls` has them under the names below, `bridge` is how XLA reaches them, `native` how they are
compiled. Each is held to its formula by a test.

| kernel | formula | test |
|---|---|---|
| `map_add` | `mapping.update.integrate_pixels` | `tests/mapping/test_kernels.py` |
| `map_mark` | `mapping.seen.rows_in_view`, `mark_rows` | `tests/mapping/test_kernels.py` |
| `sums` | `scoring.formulas.sums_in_view` | `tests/scoring/test_backends.py` |
| `changes` | `scoring.formulas.change_of_sums` | `tests/scoring/test_backends.py` |
| `pixels` | `scoring.formulas.rows_in_pixels` | `tests/scoring/test_backends.py` |
| `terms` | `scoring.terms.score_voxels` | `tests/scoring/test_backends.py` |
"""
