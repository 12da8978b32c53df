"""The named shapes against closed forms; that the cell can seal them, by vision too."""

import json

import numpy as np
import pytest

from experiments import shapes
from seal_gym.core.errors import SeamError
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore

T10, T60 = np.deg2rad(10.0), np.sqrt(3.0)
LENGTH_MM = {
    "wall_right": 200.0,
    "groove": 200.0,
    # Two legs of 80 mm, a quarter circle of 30 mm instead of the last 30 mm of each.
    "inner_corner": 160.0 - 60.0 + 30.0 * np.pi / 2,
    # Three sides of 50 mm, two turns of 60 deg on 5 mm.
    "hexagon": 150.0 + 2 * (5.0 * np.pi / 3 - 2 * 5.0 / T60),
    # Level and up by 10 deg over 80 mm each; so small a turn becomes the largest arc, of 40 mm each.
    "ramp": 80.0 / np.cos(T10) + 40.0 / np.tan(T10 / 2) * T10,
    # Half the circumference by Ramanujan's second formula.
    "ellipse": np.pi / 2 * 100.0 * (1 + 3 * 0.04 / (10 + np.sqrt(4 - 3 * 0.04))),
}


@pytest.mark.parametrize("name", LENGTH_MM)
def test_a_shape_is_as_long_as_its_closed_form(name):
    assert 1e3 * shapes.get(name).workpiece().seam.length == pytest.approx(LENGTH_MM[name], abs=0.05)


def test_a_wave_swings_by_its_amplitude():
    for name in ("s_curve", "groove_curve"):
        seam = shapes.get(name).workpiece().seam
        inside = (seam.arc >= 0) & (seam.arc <= seam.length)
        assert 1e3 * np.ptp(seam.position[inside, 1]) == pytest.approx(40.0, abs=0.1)


@pytest.mark.parametrize("name", shapes.NAMES)
def test_the_gun_leans_away_from_the_wall(name):
    shape = shapes.get(name)
    seam = shape.workpiece().seam
    right = np.cross(seam.tangent, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    sideways = np.sum(seam.approach * right, axis=1)
    expected = {"wall_right": -np.sqrt(0.5), "groove": 0.0, "groove_curve": 0.0}
    np.testing.assert_allclose(sideways, expected.get(name, np.sqrt(0.5)), atol=1e-6)


@pytest.mark.parametrize("name", shapes.NAMES)
def test_a_shape_survives_json_to_the_bit(name):
    shape = shapes.get(name)
    again = shapes.Shape.of_spec(json.loads(json.dumps(shape.spec())))
    np.testing.assert_array_equal(again.points, shape.points)
    np.testing.assert_array_equal(again.approach, shape.approach)
    plain = ("name", "joint", "corner_radius", "wall_height", "groove_width")
    assert [getattr(again, k) for k in plain] == [getattr(shape, k) for k in plain]
    assert again.workpiece().name == name


def test_a_description_with_only_points_is_a_fillet():
    shape = shapes.Shape.of_spec(
        {"name": "mine", "points_m": [[0, 0, 0], [0.1, 0, 0]], "approach": [[0, 0, 1]]}
    )
    assert (shape.joint, shape.corner_radius) == ("fillet", 5e-3)


@pytest.mark.parametrize("wrong", [{"name": "a"}, {**shapes.get("groove").spec(), "colour": 1}])
def test_a_wrong_description_is_refused(wrong):
    with pytest.raises(SeamError, match="unknown or missing"):
        shapes.Shape.of_spec(wrong)


def test_an_unknown_shape_or_side_is_refused():
    with pytest.raises(SeamError, match="'spiral': must be one of"):
        shapes.get("spiral")
    with pytest.raises(SeamError, match="wall = 'up'"):
        shapes.seam_of([[0, 0, 0], [0.1, 0, 0]], name="x", wall="up")


@pytest.mark.slow
@pytest.mark.parametrize("name", shapes.NAMES)
def test_the_cell_takes_every_shape_by_vision(name):
    core = SealCore(SealCfg.of(workpiece=shapes.get(name).workpiece(), perception="vision"), 1)
    core.reset(0, np.random.default_rng(500_000))
    observation = core.observe()
    assert observation[0, 2] == 1.0
    assert observation[0, 5] == 1.0
