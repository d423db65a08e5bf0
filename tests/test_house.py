"""The command that counts the house, and the walks of `docs/architecture.md` that it checks."""

from docs.figures import house


def test_every_step_of_a_walk_exists():
    walks = house.read_walks()
    assert len(walks) == 4
    for name, steps in walks.items():
        assert steps
        for step in steps:
            assert house.exists(step), f"{name}: {step}"


def test_a_step_that_is_gone_is_noticed():
    assert house.exists("r3jax.mapping.state.MapState.capacity")
    assert not house.exists("r3jax.mapping.state.no_such_name")
    assert not house.exists("r3jax.no_such_module")


def test_lines_of_code_leave_out_docstrings_comments_and_blanks():
    source = '"""A module."""\n\n# A comment.\nx = (1,\n     2)  # another\n'
    assert house.lines_of_code(source) == 2
