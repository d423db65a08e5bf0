"""Faults in renderability and utility."""

from tests.mutants import faults

MUTANTS = [
    *faults(
        "r3jax/scoring/terms.py",
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
