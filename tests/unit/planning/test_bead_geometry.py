"""The closed forms of the fan over two edges against brute-force geometry."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from seal_gym.core.errors import ConfigError
from seal_gym.planning import bead_geometry as bg

THETA = np.deg2rad(40.0)
NOZZLE = bg.NozzleCfg(fan_angle_rad=THETA)
N = 200


@pytest.fixture(scope="module")
def scene():
    """Random edges: points, tangents anywhere within 45 deg of straight across, speeds, drag."""
    rng = np.random.default_rng(3)
    left = rng.normal(size=(N, 3))
    turn = Rotation.random(N, rng=rng).as_matrix()
    width = rng.uniform(0.01, 0.03, N)
    right = left + width[:, None] * turn[:, :, 1]
    tangents = []
    for _ in range(2):
        skew, lift = rng.uniform(-0.7, 0.7, (2, N))
        local = np.stack((np.cos(skew), np.sin(skew), 0.3 * np.sin(lift)), axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        tangents.append(np.einsum("nij,nj->ni", turn, local))
    direction = (right - left) / width[:, None]
    sines = [np.linalg.norm(np.cross(t, direction), axis=1) for t in tangents]
    at = bg.Across(left, right, *tangents, direction, width, *sines)
    u_dot, w_dot = rng.uniform(0.1, 1.0, (2, N))
    return at, u_dot, w_dot, rng.uniform(-0.26, 0.26, N)


def rays(pose, angle):
    x, z = pose.rotation[..., 0], pose.rotation[..., 2]
    return np.sin(angle) * x - np.cos(angle) * z


def pose_of(scene):
    at, u_dot, w_dot, drag = scene
    mu = bg.distance_ratio(u_dot, w_dot, at.sin_eta, at.sin_zeta)
    return mu, bg.nozzle_pose(at, mu, drag, THETA)


def test_the_fans_borders_meet_both_edges_at_b_and_c(scene):
    at, *_ = scene
    mu, pose = pose_of(scene)
    b, c = bg.distances(mu, at.width_m, THETA)
    np.testing.assert_allclose(pose.position_m + c[:, None] * rays(pose, -THETA / 2), at.left, atol=1e-12)
    np.testing.assert_allclose(pose.position_m + b[:, None] * rays(pose, THETA / 2), at.right, atol=1e-12)


def test_the_nozzles_axis_is_the_bisector_of_the_two_rays(scene):
    at, *_ = scene
    _, pose = pose_of(scene)
    to = [p - pose.position_m for p in (at.left, at.right)]
    middle = sum(t / np.linalg.norm(t, axis=1, keepdims=True) for t in to)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    np.testing.assert_allclose(-pose.rotation[..., 2], middle, atol=1e-12)


def test_the_printed_order_of_rotations_misses_the_bisector(scene):
    at, _, _, drag = scene
    mu, pose = pose_of(scene)
    tilt, frame = bg.tilt_of_ratio(mu, THETA), at.frame()
    vector = frame[..., 0] * tilt[:, None], frame[..., 1] * -drag[:, None]
    about_x, about_y = (Rotation.from_rotvec(v).as_matrix() for v in vector)
    ours, printed = about_y @ about_x @ frame, about_x @ about_y @ frame
    np.testing.assert_allclose(-pose.rotation[..., 2], ours[..., 2], atol=1e-12)
    apart = np.arccos(np.clip(np.sum(ours[..., 2] * printed[..., 2], axis=1), -1.0, 1.0))
    assert np.rad2deg(apart.max()) > 0.5


def test_rotations_are_right_handed_with_travel_ahead(scene):
    at, *_ = scene
    _, pose = pose_of(scene)
    np.testing.assert_allclose(np.linalg.det(pose.rotation), 1.0, atol=1e-12)
    identity = np.broadcast_to(np.eye(3), (N, 3, 3))
    np.testing.assert_allclose(np.swapaxes(pose.rotation, 1, 2) @ pose.rotation, identity, atol=1e-12)
    assert np.all(np.sum(pose.rotation[..., 1] * at.frame()[..., 0], axis=1) > 0.9)


def test_distances_tilt_and_angles_by_the_triangles_corners(scene):
    at, *_ = scene
    mu, pose = pose_of(scene)
    b, c = bg.distances(mu, at.width_m, THETA)
    tilt = bg.tilt_of_ratio(mu, THETA)

    def corner(at_point, one, other):
        v, w = one - at_point, other - at_point
        return np.arccos(np.sum(v * w, 1) / np.linalg.norm(v, axis=1) / np.linalg.norm(w, axis=1))

    p = pose.position_m
    beta, gamma = corner(at.left, p, at.right), corner(at.right, p, at.left)
    np.testing.assert_allclose(np.linalg.norm(p - at.right, axis=1), b, rtol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(p - at.left, axis=1), c, rtol=1e-10)
    np.testing.assert_allclose(corner(p, at.left, at.right), THETA, rtol=1e-9)
    np.testing.assert_allclose((gamma - beta) / 2, tilt, atol=1e-9)


def test_some_entry_angles_are_obtuse(scene):
    # Where the printed arc sines of Eqs. 3.32-3.33 would take the wrong branch.
    mu, _ = pose_of(scene)
    assert np.any(np.abs(bg.tilt_of_ratio(mu, THETA)) > THETA / 2)


def test_ratio_of_tilt_is_where_the_tilt_is_reached():
    for degrees in (1.0, 30.0, 60.0):
        limit = np.deg2rad(degrees)
        root = brentq(lambda mu, limit=limit: bg.tilt_of_ratio(mu, THETA) + limit, 1.0, 1e3)
        assert bg.ratio_of_tilt(limit, THETA) == pytest.approx(root, rel=1e-9)
    assert bg.ratio_of_tilt(np.deg2rad(30.0), THETA) ** 2 == pytest.approx(2.347, abs=5e-4)


def swept_height(at, k, pose, u_dot, w_dot, edge, angle, step=1e-5):
    """Volume in a sliver of the fan over the area it sweeps between two instants, by its four corners."""
    corners = []
    for time in (-step, step):
        left = at.left[k] + time * u_dot[k] * at.left_tangent[k]
        right = at.right[k] + time * w_dot[k] * at.right_tangent[k]
        # The border of the fan stays on its edge; the ray beside it turns with the triangle's plane.
        across = (right - left) / np.linalg.norm(right - left)
        origin = (left, right)[edge]
        inwards = (1, -1)[edge]
        p, border = pose.position_m[k], (at.left[k], at.right[k])[edge]
        # Where a ray d(phi) inside the border meets the line across, in the plane of the triangle.
        reach = np.linalg.norm(border - p)
        entry = np.arccos(np.dot(p - border, inwards * at.direction[k]) / reach)
        inside = reach * np.sin(angle) / np.sin(np.pi - entry - angle)
        corners += [origin, origin + inwards * inside * across]
    a, b, c, d = corners
    area = 0.5 * np.linalg.norm(np.cross(d - a, c - b))
    return NOZZLE.flow_m3_per_s * 2 * step * (angle / THETA) / area


def test_heights_are_volume_over_swept_area(scene):
    at, u_dot, w_dot, _ = scene
    _, pose = pose_of(scene)
    g, h = bg.edge_heights(at, u_dot, w_dot, NOZZLE)
    for edge, heights in ((0, g), (1, h)):
        brute = [swept_height(at, k, pose, u_dot, w_dot, edge, 1e-5) for k in range(N)]
        np.testing.assert_allclose(heights, brute, rtol=2e-4)


def test_both_edges_get_the_same_height_in_closed_form(scene):
    at, u_dot, w_dot, _ = scene
    g, h = bg.edge_heights(at, u_dot, w_dot, NOZZLE)
    np.testing.assert_allclose(g, h, rtol=1e-12)
    closed = np.exp(bg.log_height(u_dot, w_dot, at.sin_eta, at.sin_zeta, at.width_m, NOZZLE))
    np.testing.assert_allclose(closed, g, rtol=1e-12)


@pytest.mark.parametrize(
    "values", [{"fan_angle_rad": 40.0}, {"fan_angle_rad": np.nan}, {"flow_m3_per_s": 0.0}]
)
def test_bad_nozzles(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        bg.NozzleCfg(**values)


def test_bad_paths():
    good = {
        "time_s": np.array([0.0, 1.0]),
        "position_m": np.zeros((2, 3)),
        "rotation": np.tile(np.eye(3), (2, 1, 1)),
        "flow_m3_per_s": np.ones(2),
    }
    bg.BeadPath(**good)
    with pytest.raises(ConfigError, match="rise"):
        bg.BeadPath(**good | {"time_s": np.array([1.0, 0.0])})
    with pytest.raises(ConfigError, match="position_m"):
        bg.BeadPath(**good | {"position_m": np.zeros((3, 3))})
