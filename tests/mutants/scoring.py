"""Faults in renderability, and the kernels that add it up."""

from tests.mutants import faults

MUTANTS = [
    *faults(
        "r3jax/kernels/visibility/views.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[sums_agree]",
        ("placed[COLUMN + i] = column * half + half", "placed[COLUMN + i] = column * half"),
        ("q = a if is_lower else b", "q = b"),
        ("abs(-_ONE - apart * sign_y)", "abs(_ONE - apart * sign_y)"),
        ("distance if distance <= far else _INFINITE", "distance"),
    ),
    *faults(
        "r3jax/kernels/visibility/views.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[in_images]",
        ("c0, r0 = along_x * (xx - slope_x * xz), along_y", "c0, r0 = along_x * xx, along_y"),
        ("abs(c0 - r0) + abs(c1 - r1)", "abs(c0 - r0) + abs(c1 + r1)"),
    ),
    *faults(
        "r3jax/kernels/visibility/picture.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[borders_agree]",
        ("height - 1 - row if crosses_column", "row if crosses_column"),
        ("i -= 2 * (width + 2)", "i -= 2 * width"),
    ),
    *faults(
        "r3jax/kernels/visibility/picture.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[images_all_round]",
        ("        if wraps:\n            fold", "        if False:\n            fold"),
    ),
    *faults(
        "r3jax/kernels/visibility/picture.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[sums_agree]",
        ("above + (r >> 1) * stride", "above + r * stride"),
    ),
    *faults(
        "r3jax/kernels/visibility/splat.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[sums_agree]",
        ("spread = _QUARTER if begins_level else _ZERO", "spread = _ZERO"),
        ("(in_slants | is_own)", "is_own"),
        ("+ _TWO * _RING * level + _RING", "+ _RING"),
    ),
    *faults(
        "r3jax/kernels/visibility/limit.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[sums_agree]",
        ("_flatter(before, after, np.float32(step))", "_ZERO"),
        ("return least if before * after > _ZERO else _ZERO", "return least"),
        (", _MAX_STRETCH)", ", _ONE)"),
    ),
    *faults(
        "r3jax/kernels/visibility/seen.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[sums_agree]",
        ("first = max(limit", "first = min(limit"),
        ("(distance <= nearest[pixel])", "(distance <= 2 * nearest[pixel])"),
    ),
    *faults(
        "r3jax/kernels/scoring/voxels.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[sums_agree]",
        ("counts[group] += 1\n        voxels", "voxels"),
    ),
    *faults(
        "r3jax/kernels/scoring/terms.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[sums_agree]",
        ("math.sqrt(_TWO_THIRDS_OF_TWO * variance)", "math.sqrt(variance)"),
    ),
    *faults(
        "r3jax/kernels/scoring/terms.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[terms_agree]",
        ("max(count - _ONE, _ONE)", "count"),
    ),
    *faults(
        "r3jax/kernels/scoring/terms.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[images_agree]",
        ("best = max(best, cosine)", "best = cosine"),
    ),
    *faults(
        "r3jax/kernels/scoring/terms.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[terms_agree]",
        ("apart = _ZERO if cosine > _ZERO else _INFINITE", "apart = _ZERO"),
        ("-z * a_y, z * a_x", "-z * a_x, z * a_y"),
        ("kappa * (_ONE - bias)", "(_ONE - bias)"),
    ),
    *faults(
        "r3jax/kernels/scoring/terms.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[sums_agree]",
        ("cosine if is_one else cosine * cosine", "cosine"),
        ("_ONE - delta * bias", "_ONE - bias"),
    ),
    *faults(
        "r3jax/kernels/mapping/bins.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[sums_agree]",
        ("is_better = cosine > best", "is_better = k == 0"),
    ),
    *faults(
        "r3jax/kernels/scoring/sums.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[in_images]",
        ("found.centers[axis, order[k]]", "found.centers[axis, k]"),
    ),
    *faults(
        "r3jax/kernels/scoring/pixels.py",
        "tests/scoring/test_kernel_faults.py::test_the_laws_hold[images_agree]",
        (
            "key_of(placed[DISTANCE + i], numbers[first + i])",
            "key_of(placed[DISTANCE + i], first + i)",
        ),
        ("if row != last:", "if last < 0:"),
    ),
    *faults(
        "r3jax/scoring/directions.py",
        "tests/scoring/test_laws.py::test_terms_follow_their_formulas",
        ("is_ahead = cosine > 0.0", "is_ahead = cosine > -0.5"),
        ("best = jnp.maximum(best, cosine)", "best = cosine"),
        ("jnp.clip(best, 0.0, 1.0), is", "jnp.abs(best), is"),
        ("is_inside &= (b_low", "is_inside |= (b_low"),
        ("-z * a_y, z * a_x", "-z * a_x, z * a_y"),
    ),
    *faults(
        "r3jax/scoring/terms.py",
        "tests/scoring/test_laws.py::test_terms_follow_their_formulas",
        ("cosine, cosine * cosine)", "cosine, cosine)"),
        ("kappa_value * (1.0 - bias)", "1.0 - bias"),
        ("1.0 - delta * bias", "1.0 - bias"),
        ("* distance / focal, 1.0)", "* distance / focal, 2.0)"),
        ("value=blank(bias * noise * resolution)", "value=blank(bias * noise)"),
        ("jnp.where(voxels.present, term, 0.0)", "term"),
        ("2.0 / 1.5 * variance", "2.0 * variance"),
        ("jnp.maximum(count - 1.0, 1.0)", "jnp.maximum(count, 1.0)"),
        ("count > 1.0, jnp.clip", "count > 3.0, jnp.clip"),
    ),
    *faults(
        "r3jax/scoring/soft_utility.py",
        "tests/scoring/test_soft_utility.py::test_the_sum_matches_an_oracle",
        ("* jnp.sqrt(1.0 + k * k))", ")"),
        ("(-1.0, (size - center) / focal)", "(-1.0, center / focal)"),
        ("visible = self.count * jax.nn.sigmoid(left)", "visible = self.count"),
    ),
    *faults(
        "r3jax/scoring/soft_utility.py",
        "tests/scoring/test_soft_utility.py::test_without_softness_it_is_the_utility",
        ("broadcast_to(self.config.lambda1,", "broadcast_to(1.0,"),
        ("half + _MARGIN, _WIDEST", "0.5 * half, _WIDEST"),
    ),
    *faults(
        "r3jax/scoring/soft_utility.py",
        "tests/scoring/test_soft_utility.py::test_a_sample_counts_for_all",
        ("jnp.maximum(count / most, 1.0)", "1.0 + 0.0 * count"),
    ),
]
