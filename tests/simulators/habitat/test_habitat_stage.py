"""Which mesh a scene's file shows, and how Habitat turns it."""

import json

import numpy as np
import pytest

from r3jax.simulators.habitat.habitat_stage import read_stage

Z_UP = {"up": [0, 0, 1], "front": [0, 1, 0]}
Y_UP = {"up": [0, 1, 0], "front": [0, 0, -1]}
TURN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture
def config(tmp_path):
    """Writes a stage config into `habitat/`, beside a mesh, as Replica has them."""
    (tmp_path / "mesh.ply").write_bytes(b"ply")
    (tmp_path / "mesh.glb").write_bytes(b"glb")
    (tmp_path / "habitat").mkdir()

    def write(text):
        path = tmp_path / "habitat" / "a.stage_config.json"
        path.write_text(text if isinstance(text, str) else json.dumps(text))
        return path

    return write


@pytest.mark.parametrize(("name", "turn"), [("a.glb", TURN), ("a.GLB", TURN), ("a.ply", np.eye(3))])
def test_bare_meshes_as_measured(tmp_path, name, turn):
    (tmp_path / name).write_bytes(b"mesh")
    stage = read_stage(tmp_path / name)
    assert stage.file == stage.mesh == tmp_path / name
    np.testing.assert_array_equal(stage.habitat_from_file, turn)


@pytest.mark.parametrize(("axes", "turn"), [(Z_UP, TURN), (Y_UP, np.eye(3))])
def test_a_stage_config_says_its_axes(config, tmp_path, axes, turn):
    more = {"scale": [1.0, 1.0, 1.0], "units_to_meters": 1, "semantic_asset": "mesh_semantic.ply"}
    path = config({"render_asset": "../mesh.glb", **axes, **more})
    stage = read_stage(path)
    assert stage.file == path
    assert stage.mesh.resolve() == tmp_path / "mesh.glb"
    np.testing.assert_array_equal(stage.habitat_from_file, turn)


@pytest.mark.parametrize("axes", [Z_UP, Y_UP, {}, {"up": [0, 0, 1], "front": [0, 0, 1]}])
def test_a_ply_is_never_turned_whatever_its_config_says(config, axes):
    """Measured on the real one: four configs, all 24 rotations, the identity each time."""
    stage = read_stage(config({"render_asset": "../mesh.ply", **axes}))
    assert stage.is_ply
    np.testing.assert_array_equal(stage.habitat_from_file, np.eye(3))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({**Z_UP}, "names no render_asset"),
        ({"render_asset": 3, **Z_UP}, "render_asset"),
        ({"render_asset": "no.ply", **Z_UP}, r"render_asset .*no\.ply is missing"),
        ({"render_asset": "..", **Z_UP}, "this is a folder"),
        ({"render_asset": "../mesh.glb"}, "does not say up and front"),
        ({"render_asset": "../mesh.glb", "up": [0, 0, 1]}, "does not say front"),
        ({"render_asset": "../mesh.glb", "up": "z", "front": [0, 1, 0]}, "up"),
        ({"render_asset": "../mesh.glb", "up": [0, 0, 1], "front": [0, 0, 1]}, "right angles"),
        ({"render_asset": "../mesh.glb", "up": [0, 1], "front": [0, 0, 1]}, "3 numbers"),
        ({"render_asset": "../mesh.glb", **Z_UP, "scale": [2, 2, 2]}, "scale .* not supported"),
        ({"render_asset": "../mesh.glb", **Z_UP, "origin": [1, 0, 0]}, "origin .* not supported"),
        (["render_asset"], "stage config"),
        ("{", "not JSON"),
    ],
)
def test_configs_that_cannot_be_followed(config, fields, reason):
    path = config(fields)
    with pytest.raises(ValueError, match=reason) as caught:
        read_stage(path)
    assert str(path) in str(caught.value)


def test_other_files(tmp_path):
    (tmp_path / "a.obj").write_bytes(b"mesh")
    with pytest.raises(ValueError, match=r"a\.obj: Habitat scenes are \.glb, \.ply or"):
        read_stage(tmp_path / "a.obj")
    with pytest.raises(ValueError, match=r"no such file for Habitat: .*b\.glb"):
        read_stage(tmp_path / "b.glb")
    with pytest.raises(ValueError, match=r"no such file for Habitat: .*b\.stage_config\.json"):
        read_stage(tmp_path / "b.stage_config.json")
    (tmp_path / "c.ply").mkdir()
    with pytest.raises(ValueError, match="this is a folder"):
        read_stage(tmp_path / "c.ply")
