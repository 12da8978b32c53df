import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.sim.depth import DepthCfg, DepthSensor
from seal_gym.sim.depth_seam import SeamPointCfg, find_seam, fit_line, median_filter, split
from seal_gym.sim.gun_room import tip_poses
from seal_gym.sim.scene import cached_scene
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.seam import nearest_on_path
from seal_gym.workpieces.workpiece import Workpiece

ACROSS = np.linspace(-0.0125, 0.0125, 160)


def valley(corner, left_deg, right_deg):
    """Depth of a hollow corner: lines that fall towards it at these angles to the sensor's axis."""
    off = ACROSS - corner[0]
    slope = np.where(off < 0, 1 / np.tan(np.deg2rad(left_deg)), -1 / np.tan(np.deg2rad(right_deg)))
    return corner[1] + slope * off


def grooved(middle, width, depth, tilt):
    floor = np.abs(ACROSS - middle) < width / 2
    return 0.1 + tilt * ACROSS + np.where(floor, depth, 0.0)


@pytest.mark.parametrize("angles", [(45, 45), (35, 55), (60, 40)])
@pytest.mark.parametrize("corner", [(0.0, 0.1), (-0.006, 0.105), (0.007, 0.095)])
def test_corner_of_a_clean_fillet(angles, corner):
    fix = find_seam(ACROSS, valley(corner, *angles))
    np.testing.assert_allclose(fix[:2], corner, atol=1e-5)  # the median filter rounds it by a point


def test_corner_in_noise_and_dropout():
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(200):
        corner = np.array([rng.uniform(-6e-3, 6e-3), 0.1 + rng.uniform(-5e-3, 5e-3)])
        depth = valley(corner, *rng.uniform(35, 55, 2)) + rng.normal(0, 5e-5, len(ACROSS))
        depth[rng.random(len(ACROSS)) < 0.1] = np.nan
        depth[np.abs(ACROSS - corner[0]) < 5e-4] = np.nan  # light lost in the corner
        errors.append(np.array(find_seam(ACROSS, depth)[:2]) - corner)
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=1))) < 3e-5
    assert np.abs(errors).max() < 1.5e-4


def test_a_low_step_beside_the_fillet_does_not_mislead():
    depth = valley((0.001, 0.1), 45, 45)
    depth[:30] = 0.09  # the wall's top
    np.testing.assert_allclose(find_seam(ACROSS, depth)[:2], (0.001, 0.1), atol=1e-6)


@pytest.mark.parametrize("tilt", [-0.2, 0.0, 0.3])
@pytest.mark.parametrize("middle", [0.0, 0.0051, -0.0083])
def test_middle_of_a_groove(tilt, middle):
    fix = find_seam(ACROSS, grooved(middle, 2e-3, 2e-3, tilt))
    step = ACROSS[1] - ACROSS[0]
    assert abs(fix.across_m - middle) <= step / 2
    assert abs(fix.depth_m - (0.1 + tilt * fix.across_m)) < 1e-5


def test_groove_in_noise():
    rng = np.random.default_rng(1)
    for _ in range(100):
        middle = rng.uniform(-8e-3, 8e-3)
        depth = grooved(middle, 2e-3, 2e-3, 0.1) + rng.normal(0, 5e-5, len(ACROSS))
        depth[rng.random(len(ACROSS)) < 0.05] = np.nan
        fix = find_seam(ACROSS, depth)
        assert abs(fix.across_m - middle) < 4e-4
        assert abs(fix.depth_m - 0.1 - 0.1 * middle) < 1e-4


@pytest.mark.parametrize(
    "depth",
    [
        0.1 + 0.3 * ACROSS,  # a plane
        2 * 0.1 - valley((0.0, 0.1), 45, 45),  # a ridge
        np.where(ACROSS > 0.002, 0.12, 0.1),  # the plate's edge
        grooved(0.0, 8e-3, 2e-3, 0.0),  # too wide
        grooved(0.0, 2e-3, 1e-4, 0.0),  # a scratch
        np.full(160, np.nan),
    ],
)
def test_where_there_is_no_seam_none_is_found(depth):
    assert find_seam(ACROSS, depth) is None


def test_too_few_points_are_no_seam():
    depth = valley((0.0, 0.1), 45, 45)
    depth[np.arange(160) % 20 != 0] = np.nan
    assert find_seam(ACROSS, depth) is None


def test_median_filter_takes_spikes_out_and_leaves_steps():
    values = np.array([0.0, 0.0, 9.0, 0.0, 0.0, 5.0, 5.0, 5.0])
    np.testing.assert_array_equal(median_filter(values, 3), [0, 0, 0, 0, 0, 5, 5, 5])


def test_split_finds_three_lines():
    knots = np.array([[0.0, 0.0], [4e-3, 3e-3], [8e-3, 0.0], [12e-3, 2e-3]])
    x = np.linspace(0, 12e-3, 121)
    profile = np.column_stack((x, np.interp(x, *knots.T)))
    lines = split(profile, SeamPointCfg())
    slopes = [line.direction[1] / line.direction[0] for line in lines]
    np.testing.assert_allclose(slopes, [0.75, -0.75, 0.5], atol=1e-9)


def test_a_line_fits_a_vertical_face():
    points = np.column_stack((np.full(9, 2e-3), np.linspace(0.1, 0.09, 9)))
    line = fit_line(points, 1)
    np.testing.assert_allclose(line.direction, [0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(line.centre, [2e-3, 0.095], atol=1e-12)


@pytest.mark.parametrize("part", ["flat", "cylinder", "rectangular", "groove"])
def test_seam_of_real_parts_in_noise(part):
    if part == "groove":
        part = Workpiece.from_polyline(
            [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0]], [0, 0, 1], joint="groove", corner_radius=0.01
        )
    scene = cached_scene(catalogue.get(part), load_cell())
    seam, pose = scene.workpiece.seam, scene.workpiece.pose
    tips = tip_poses(scene, np.linspace(0, seam.length, 120))
    sensor = DepthSensor(scene, DepthCfg())
    rngs = [np.random.default_rng(k) for k in range(120)]
    profile = sensor.measure(pose @ tips, np.broadcast_to(pose, tips.shape), rngs)
    off = []
    for across, depth, tip in zip(*profile, tips, strict=True):
        fix = find_seam(across, depth)  # at corners as well: the line stays on the wall
        point = sensor.to_base(np.array(fix.across_m), np.array(fix.depth_m), tip)
        off.append(nearest_on_path(seam.position, seam.arc, point, seam.arc[0], seam.arc[-1])[0])
    assert np.sqrt(np.mean(np.square(off))) < 5e-5
    assert max(off) < 3e-4


@pytest.mark.parametrize(
    "change",
    [{"median": 4}, {"trim": -1}, {"min_points": 4}, {"tolerance_m": 0.0}, {"turn_rad": (2.0, 1.0)}],
)
def test_nonsense_is_refused(change):
    with pytest.raises(ConfigError, match=next(iter(change))):
        SeamPointCfg(**change)
