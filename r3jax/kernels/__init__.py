"""Machine code for CPUs: formulas of other packages as batched functions of arrays.

`calls` has them under the names below, `bridge` is how XLA reaches them, `native` how they are
compiled. A test compares each with its formula.

| kernel | formula | test, in `tests` |
|---|---|---|
| `map_add` | `mapping.update.integrate_pixels` | `mapping/test_kernels.py` |
| `map_look` | `mapping.seen.rows_in_view`, `mark_rows` | `mapping/test_kernels.py` |
| | `mapping.moved.count_misses` | `mapping/test_moved.py` |
| `grid_depth` | `mapping.occupancy.integrate_depth` | `mapping/test_occupancy.py` |
| `sums` | `scoring.formulas.sums_in_view` | `scoring/test_backends.py` |
| `changes` | `scoring.formulas.change_of_sums` | `scoring/test_backends.py` |
| `pixels` | `scoring.formulas.rows_in_pixels` | `scoring/test_backends.py` |
| `gains`, `add` | `apps.select.objective.Objective` | `apps/select/test_objective.py` |
| `composite` | `splatting.backends.reference.rasterize` | `splatting/backends/test_numba.py` |
| `composite_gradient` | the same, by `jax.grad` | `splatting/backends/test_numba.py` |
| `image_loss` | `training.train_step.photometric_loss` | `splatting/training/test_kernels.py` |
| `adam` | `splatting.training.optimizer.adam_update` | `splatting/training/test_kernels.py` |
| `squares` | `baselines.information.pixel_squares` | `baselines/test_information.py` |
| `tallies` | `baselines.information.pixel_tallies` | `baselines/test_information.py` |
| `sweep.plane_scores` | `captures.sweep.plane_scores` | `captures/test_sweep.py` |
| `sweep.smooth_scores` | `captures.sweep.smooth_scores` | `captures/test_sweep.py` |
"""
