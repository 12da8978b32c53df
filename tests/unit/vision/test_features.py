"""ROI features against lines whose place in the tip frame is known, and against projections by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.core.cell import load_cell
from seal_gym.vision.features import RoiFeatures, ViewGeometry, oracle_lines, update_features

CELL = load_cell()
VIEWS = ViewGeometry.of(CELL)
STAND_OFF = 0.003


def world_lines(rng, n, x, z, heading, pitch):
    """A line a row, given in the tip frame, seen by a tip in a random pose."""
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, :3, :3] = Rotation.random(n, random_state=rng).as_matrix()
    pose[:, :3, 3] = rng.uniform(-1, 1, (n, 3))
    direction = np.stack((np.tan(heading), np.ones(n), np.tan(pitch)), axis=1)
    point = np.stack((x, np.zeros(n), z - STAND_OFF), axis=1) + rng.uniform(-2e-3, 2e-3, (n, 1)) * direction
    tangent = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    world = np.einsum("nij,nj->ni", pose[:, :3, :3], point) + pose[:, :3, 3]
    return world, np.einsum("nij,nj->ni", pose[:, :3, :3], tangent), pose, point, direction


def draw(seed, n=200):
    rng = np.random.default_rng(seed)
    x, z = rng.uniform(-3e-3, 3e-3, (2, n))
    heading, pitch = rng.uniform(-0.12, 0.12, (2, n))
    return x, z, heading, pitch, world_lines(rng, n, x, z, heading, pitch)


def pinhole(camera, points):
    """By the textbook: look-at axes, divide by depth, shift the mouth's image to ``tip_px``."""
    eye, target = np.array(camera.position_mm) / 1e3, np.array(camera.target_mm) / 1e3
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, camera.up)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)

    def raw(p):
        p = np.atleast_2d(p) - eye
        return camera.focal_px * np.column_stack((p @ x, p @ y)) / (p @ z)[:, None]

    return raw(points) - raw(np.zeros(3)) + np.array(camera.tip_px)


def test_features_recover_a_known_line():
    x, z, heading, pitch, (world, tangent, pose, _, _) = draw(0)
    features = RoiFeatures.zeros(len(x))
    lines = oracle_lines(world, tangent, pose, VIEWS)
    assert lines.valid.all()
    update_features(features, lines, VIEWS)
    assert features.valid.all()
    np.testing.assert_allclose(features.d_m, np.stack((x, z), axis=1), atol=1e-9, rtol=0)
    np.testing.assert_allclose(features.theta_rad, np.stack((heading, pitch), axis=1), atol=1e-9, rtol=0)
    np.testing.assert_allclose(features.point_m[:, 1], 0.0, atol=0)
    np.testing.assert_allclose(np.linalg.norm(features.direction, axis=1), 1.0, atol=1e-12)
    assert (features.direction[:, 1] > 0).all()


def test_direction_of_travel_does_not_matter_for_a_line():
    _, _, _, _, (world, tangent, pose, _, _) = draw(1, 20)
    there, back = RoiFeatures.zeros(20), RoiFeatures.zeros(20)
    update_features(there, oracle_lines(world, tangent, pose, VIEWS), VIEWS)
    update_features(back, oracle_lines(world, -tangent, pose, VIEWS), VIEWS)
    for a, b in zip(there, back, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.parametrize("view", [0, 1])
def test_pixel_features_by_hand(view):
    _, _, _, _, (world, tangent, pose, point, direction) = draw(2)
    features = RoiFeatures.zeros(len(world))
    update_features(features, oracle_lines(world, tangent, pose, VIEWS), VIEWS)
    camera = CELL.cameras[view]
    a, b = pinhole(camera, point), pinhole(camera, point + 1e-4 * direction)
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    reference = pinhole(camera, np.array([0.0, 0.0, -STAND_OFF]))[0]
    foot = a + np.sum((reference - a) * along, axis=1, keepdims=True) * along
    np.testing.assert_allclose(features.d_px[:, view], (foot - reference)[:, view], atol=1e-8)
    # Pixels count down: travel is up in the front view, to the right in the side view.
    if view == 0:
        assert (along[:, 1] < 0).all()
        angle = np.arctan2(along[:, 0], -along[:, 1])
    else:
        assert (along[:, 0] > 0).all()
        angle = np.arctan2(-along[:, 1], along[:, 0])
    np.testing.assert_allclose(features.theta_px_rad[:, view], angle, atol=1e-8)
    assert (np.abs(features.theta_px_rad) <= np.pi / 2).all()


def test_signs_of_the_features():
    """A seam to the right gives d_front > 0; one above the stand-off point gives d_side > 0."""
    one = np.eye(4)[None]
    y = np.array([[0.0, 1.0, 0.0]])
    features = RoiFeatures.zeros(1)
    update_features(features, oracle_lines(np.array([[1e-3, 0, -STAND_OFF + 2e-3]]), y, one, VIEWS), VIEWS)
    np.testing.assert_allclose(features.d_m, [[1e-3, 2e-3]], atol=1e-12)
    turned = np.array([[np.sin(0.1), np.cos(0.1), 0.0]])
    update_features(features, oracle_lines(np.array([[0, 0, -STAND_OFF]]), turned, one, VIEWS), VIEWS)
    np.testing.assert_allclose(features.theta_rad, [[0.1, 0.0]], atol=1e-12)


def seen_length(camera, point, direction):
    """Length of the line in the ROI by brute force: a fine walk along it."""
    t = np.linspace(-0.12, 0.12, 400_001)[:, None]
    px = pinhole(camera, point + t * direction)
    inside = ((px >= 0) & (px <= np.array(camera.roi_px))).all(axis=1)
    steps = np.linalg.norm(np.diff(px, axis=0), axis=1)
    return steps[inside[1:] & inside[:-1]].sum()


def test_a_line_is_valid_where_twenty_pixels_of_it_are_in_the_roi():
    rng = np.random.default_rng(3)
    n = 60
    x, z = rng.uniform(-16e-3, 16e-3, (2, n))
    heading, pitch = rng.uniform(-0.5, 0.5, (2, n))
    world, tangent, pose, point, direction = world_lines(rng, n, x, z, heading, pitch)
    lines = oracle_lines(world, tangent, pose, VIEWS)
    seen = np.array([[seen_length(c, point[i], direction[i]) for c in CELL.cameras] for i in range(n)])
    clear = np.abs(seen - 20.0) > 0.5
    assert 10 < lines.valid.sum() < 2 * n - 10
    np.testing.assert_array_equal(lines.valid[clear], (seen >= 20.0)[clear])


def test_out_of_the_roi_is_invalid_and_the_last_values_stay():
    pose, y = np.eye(4)[None], np.array([[0.0, 1.0, 0.0]])
    features = RoiFeatures.zeros(1)
    update_features(features, oracle_lines(np.array([[1e-3, 0, -2e-3]]), y, pose, VIEWS), VIEWS)
    before = [values.copy() for values in features]
    # 30 mm to the right is beyond the front view; along its own ray the side view still shows the line.
    eye = np.array(CELL.side.position_mm) / 1e3
    ray = eye - np.array([0.0, 8e-3, -STAND_OFF])
    beside = np.array([0.0, 8e-3, -STAND_OFF]) + 0.4 * ray
    lines = oracle_lines(beside[None], y, pose, VIEWS)
    np.testing.assert_array_equal(lines.valid, [[False, True]])
    update_features(features, lines, VIEWS)
    np.testing.assert_array_equal(features.valid, [[False, True]])
    for k in (0, 1, 5, 6):  # d_m, theta, point and direction need both views
        np.testing.assert_array_equal(features[k], before[k])
    assert features.d_px[0, 0] == before[2][0, 0]
    assert features.d_px[0, 1] != before[2][0, 1]


def test_behind_the_camera_is_invalid():
    y = np.array([[0.0, 1.0, 0.0]])
    above = np.array([[0.0, 200e-3, 300e-3]])
    assert not oracle_lines(above, y, np.eye(4)[None], VIEWS).valid.any()


def test_clear_forgets_one_row():
    _, _, _, _, (world, tangent, pose, _, _) = draw(4, 3)
    features = RoiFeatures.zeros(3)
    update_features(features, oracle_lines(world, tangent, pose, VIEWS), VIEWS)
    kept = features.d_m[2].copy()
    features.clear(1)
    for values, fresh in zip(features, RoiFeatures.zeros(1), strict=True):
        np.testing.assert_array_equal(values[1], fresh[0])
    np.testing.assert_array_equal(features.d_m[2], kept)


def test_parallel_planes_are_invalid_not_infinite():
    """Two views of a line across the travel (no point at y = 0) must not divide by zero."""
    x_axis = np.array([[1.0, 0.0, 0.0]])
    features = RoiFeatures.zeros(1)
    lines = oracle_lines(np.array([[0.0, 4e-3, -STAND_OFF]]), x_axis, np.eye(4)[None], VIEWS)
    update_features(features, lines._replace(valid=np.ones((1, 2), np.bool_)), VIEWS)
    assert not features.valid.any()
    assert all(np.isfinite(values).all() for values in features)
