"""Cross-sections of analytic beads, and what the surrogate is told, by hand."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.sealant.laydown import mesh as meshes
from seal_gym.sealant.laydown import sections
from seal_gym.sealant.laydown.config import LaydownCfg, LaydownError, TcpPath
from seal_gym.sealant.laydown.substrates import SUBSTRATES
from tests.unit.sealant.laydown.cases import FLOW_M3S, straight


def bead(profile, cell_m=1e-3, subs=10):
    """A mesh on a plane and a bead along y whose height is a function of x."""
    mesh = meshes.build(
        SUBSTRATES["plane"], np.array([-18e-3, -20e-3]), np.array([18e-3, 20e-3]), 10e-3, cell_m
    )
    nx, ny, nz = mesh.cell_ids.shape
    x = mesh.origin[0] + (np.arange(nx * subs) + 0.5) * cell_m / subs
    z = (np.arange(nz * subs) + 0.5) * cell_m / subs
    full = z[None] < np.asarray(profile(x))[:, None]
    section = full.reshape(nx, subs, nz, subs).mean((1, 3))
    return mesh, np.repeat(section[:, None], ny, 1).reshape(-1)


def parabola(x):
    return np.maximum(4e-3 * (1 - (x / 8e-3) ** 2), 0.0)


def test_a_rectangular_bead():
    mesh, fractions = bead(lambda x: np.where(np.abs(x) < 5e-3, 3e-3, 0.0))
    image = sections.cut(mesh, fractions, np.zeros((1, 3)), np.eye(3)[None])
    assert image.shape == (1, 20, 40)
    expected = np.zeros((20, 40))
    expected[8:11, 15:25] = 1.0
    np.testing.assert_array_equal(image[0], expected)
    assert sections.area_m2(image)[0] == pytest.approx(30e-6)
    assert sections.height_m(image)[0] == pytest.approx(3e-3)
    # 0.5 mm lies between the middles of the last full column (3 mm) and the first empty one: 5/6 out
    assert sections.width_m(image)[0] == pytest.approx((9 + 2 * 5 / 6) * 1e-3)


def test_a_parabolic_bead():
    mesh, fractions = bead(parabola, cell_m=0.5e-3)
    image = sections.cut(mesh, fractions, np.zeros((1, 3)), np.eye(3)[None])
    assert sections.area_m2(image)[0] == pytest.approx(2 / 3 * 4e-3 * 16e-3, rel=2e-3)
    assert sections.height_m(image)[0] == pytest.approx(4e-3, rel=0.02)
    assert sections.width_m(image)[0] == pytest.approx(16e-3 * math.sqrt(7 / 8), abs=0.15e-3)


def test_an_oblique_cut_is_larger():
    mesh, fractions = bead(parabola, cell_m=0.5e-3)
    turn = Rotation.from_euler("Z", 40.0, degrees=True).as_matrix()
    image = sections.cut(mesh, fractions, np.zeros((1, 3)), turn[None])
    whole = 2 / 3 * 4e-3 * 16e-3
    assert sections.area_m2(image)[0] == pytest.approx(whole / math.cos(math.radians(40)), rel=5e-3)


def test_a_bead_to_the_right_is_on_the_right():
    mesh, fractions = bead(lambda x: np.where(np.abs(x - 8e-3) < 2e-3, 2e-3, 0.0))
    image = sections.cut(mesh, fractions, np.zeros((1, 3)), np.eye(3)[None])[0]
    assert set(np.flatnonzero(image.any(0))) == {26, 27, 28, 29}
    assert set(np.flatnonzero(image.any(1))) == {8, 9}


def test_iou_by_hand():
    one, two = np.zeros((2, 20, 40))
    one[5:8, 10:20] = 0.9
    two[5:8, 12:22] = 0.6
    two[0, 0] = 0.4  # less than half: not bead
    assert sections.iou(one, two) == pytest.approx(8 / 12)
    assert sections.iou(one, one) == 1.0
    assert sections.iou(np.zeros((20, 40)), np.zeros((20, 40))) == 1.0
    assert sections.iou(one, np.zeros((20, 40))) == 0.0


def test_no_bead_has_no_width():
    empty = np.zeros((3, 20, 40))
    assert sections.width_m(empty).tolist() == [0.0, 0.0, 0.0]
    assert sections.area_m2(empty).tolist() == sections.height_m(empty).tolist() == [0.0, 0.0, 0.0]


def test_stations_of_a_straight_path():
    at = sections.stations(straight(substrate="step", x_m=0.0))
    assert len(at.arcs_m) == 30
    np.testing.assert_allclose(np.diff(at.arcs_m), 1e-3)
    np.testing.assert_allclose(at.linear_mps, [[0.0, 0.3, 0.0]] * 30, atol=1e-12)
    np.testing.assert_allclose(at.angular_radps, 0.0, atol=1e-12)
    np.testing.assert_allclose(at.gravity_mps2, [[0.0, 0.0, -9.81]] * 30)
    left = np.arange(41) < 20  # x from -20 to 20 mm
    np.testing.assert_allclose(at.heights_m[:, left], 0.030, atol=1e-8)
    np.testing.assert_allclose(at.heights_m[:, ~left], 0.026, atol=1e-8)
    np.testing.assert_allclose(at.ideal_m2, FLOW_M3S / 0.3)


def test_stations_of_a_tilted_turning_tip():
    start = Rotation.from_euler("Y", 20.0, degrees=True)
    turned = start * Rotation.from_rotvec([0.0, 0.0, 0.5])  # about its own nozzle
    path = TcpPath(
        times_s=np.array([0.0, 0.1]),
        positions=np.array([[0, 0, 0.03], [0, 0.03, 0.03]]),
        rotations=np.stack((start.as_matrix(), turned.as_matrix())),
        flows_m3s=np.full(2, FLOW_M3S),
    )
    at = sections.stations(LaydownCfg(path=path))
    np.testing.assert_allclose(at.angular_radps, [[0, 0, 5.0]] * len(at.arcs_m), atol=1e-9)
    tilt = math.radians(20.0)
    down = 9.81 * np.array([math.sin(tilt), 0.0, -math.cos(tilt)])
    np.testing.assert_allclose(at.gravity_mps2[0], down, atol=1e-9)
    np.testing.assert_allclose(at.linear_mps[0], [0.0, 0.3, 0.0], atol=2e-3)
    # a ray from s along the tip's x axis starts s sin(tilt) lower, and all run at the tilt
    side = np.arange(-20, 21) * 1e-3
    heights = (0.03 - side * math.sin(tilt)) / math.cos(tilt)
    np.testing.assert_allclose(at.heights_m[0], heights, atol=1e-8)
    np.testing.assert_allclose(at.hits[0], [-0.03 * math.tan(tilt), 0.0, 0.0], atol=1e-8)


def test_a_ray_past_the_substrate_ends_at_the_limit():
    turn = Rotation.from_euler("Y", 75.0, degrees=True).as_matrix()
    at = sections.stations(straight(rotation=turn, height_m=0.02))
    assert at.heights_m.max() == sections.RAY_LIMIT_M
    with pytest.raises(LaydownError, match="points past the substrate"):
        sections.stations(straight(rotation=turn, height_m=0.05))
