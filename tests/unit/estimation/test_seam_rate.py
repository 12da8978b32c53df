"""The seam's motion from synthetic lines and tip poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.estimation.seam_rate import SeamRate

DT = 1 / 30
SEEN = np.array([True])


def look(point, direction, pose):
    """The line of the world in the tip frame: its point at y = 0 and its direction, y > 0."""
    rotation, position = pose[:3, :3], pose[:3, 3]
    p, d = rotation.T @ (point - position), rotation.T @ direction
    d = d if d[1] > 0 else -d
    return (p - d * p[1] / d[1])[None], (d / np.linalg.norm(d))[None]


def pose_of(position, rotation=None):
    pose = np.eye(4)
    pose[:3, :3] = np.eye(3) if rotation is None else rotation
    pose[:3, 3] = position
    return pose


def run(steps, frame):
    """Feeds frames k = 0.. of (point, direction, pose) and gives the last estimate."""
    rate = SeamRate(1, DT)
    for k in range(steps):
        point, direction, pose = frame(k * DT)
        rate.update(*look(point, direction, pose), pose[None], SEEN)
    return rate.twist[0]


def test_a_straight_seam_at_rest_has_no_rate_however_the_tip_moves():
    along = np.array([0.1, 1.0, 0.05]) / np.linalg.norm([0.1, 1.0, 0.05])

    def frame(t):
        turn = Rotation.from_euler("xyz", [0.3 * np.sin(t), 0.2 * t, 0.1 * np.cos(3 * t)]).as_matrix()
        return np.array([2e-3, 0.0, 1e-3]), along, pose_of([0.01 * t, 0.02 * t, 0.005 * np.sin(t)], turn)

    np.testing.assert_allclose(run(40, frame), 0.0, atol=1e-9)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_curved_seam_turns_at_v_over_r(side):
    radius, speed = 0.07, 0.01

    def frame(t):
        angle = side * speed * t / radius
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        tangent = side * np.array([-out[1], out[0], 0.0])
        up = np.array([0.0, 0.0, 1.0])
        rotation = np.column_stack((np.cross(tangent, up), tangent, up))
        return radius * out, tangent, pose_of(radius * out, rotation)

    twist = run(60, frame)
    np.testing.assert_allclose(twist[5], side * speed / radius, rtol=1e-4)
    np.testing.assert_allclose(twist[:5], 0.0, atol=1e-6)


def test_a_moving_part_shows_its_velocity_across_the_seam_only():
    velocity = np.array([4e-3, 7e-3, -2e-3])

    def frame(t):
        return (
            np.array([1e-3, 0.0, 0.0]) + velocity * t,
            np.array([0.0, 1.0, 0.0]),
            pose_of([0.0, 0.01 * t, 0.0]),
        )

    np.testing.assert_allclose(run(60, frame), [4e-3, 0, -2e-3, 0, 0, 0], atol=1e-12)


def test_the_velocity_is_in_the_tip_frame():
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    velocity = turn @ np.array([3e-3, 0.0, 0.0])

    def frame(t):
        return velocity * t, turn @ np.array([0.0, 1.0, 0.0]), pose_of(np.zeros(3), turn)

    np.testing.assert_allclose(run(60, frame), [3e-3, 0, 0, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize(("axis", "index"), [([0, 0, 1.0], 5), ([1.0, 0, 0], 3)])
def test_a_turning_part_shows_its_rate(axis, index):
    omega = 0.05

    def frame(t):
        direction = Rotation.from_rotvec(omega * t * np.array(axis)).apply([0.0, 1.0, 0.0])
        return np.zeros(3), direction, pose_of(np.zeros(3))

    expected = np.zeros(6)
    expected[index] = omega
    np.testing.assert_allclose(run(60, frame), expected, atol=1e-5)


def test_the_gain_is_a_share_of_the_new_difference():
    rate = SeamRate(1, DT, gain=0.25)
    y = np.array([[0.0, 1.0, 0.0]])
    for k in range(3):
        rate.update(np.array([[k * 1e-3, 0.0, 0.0]]), y, np.eye(4)[None], SEEN)
    np.testing.assert_allclose(rate.twist[0, 0], 1e-3 / DT * (0.25 + 0.75 * 0.25), rtol=1e-12)


def test_an_unseen_line_lets_the_estimate_fade_and_no_difference_spans_the_gap():
    rate = SeamRate(1, DT, gain=0.5)
    y = np.array([[0.0, 1.0, 0.0]])
    for k in range(10):
        rate.update(np.array([[k * 1e-4, 0.0, 0.0]]), y, np.eye(4)[None], SEEN)
    before = rate.twist[0, 0]
    for _ in range(2):
        rate.update(np.array([[0.0, 0.0, 0.0]]), y, np.eye(4)[None], ~SEEN)
    np.testing.assert_allclose(rate.twist[0, 0], before / 4)
    rate.update(np.array([[1.0, 0.0, 0.0]]), y, np.eye(4)[None], SEEN)  # back, a metre away
    np.testing.assert_allclose(rate.twist[0, 0], before / 4)


def test_reset_and_rows_touch_their_rows_only():
    rng = np.random.default_rng(0)
    rate, other = SeamRate(3, DT), SeamRate(3, DT)
    poses = np.tile(np.eye(4), (3, 1, 1))

    def frame():
        direction = np.array([0.0, 1.0, 0.0]) + 0.1 * rng.normal(size=(3, 3))
        return rng.normal(size=(3, 3)), direction / np.linalg.norm(direction, axis=1, keepdims=True)

    frames = [frame() for _ in range(6)]
    for p, d in frames[:4]:
        rate.update(p, d, poses, np.ones(3, np.bool_))
        other.update(p, d, poses, np.ones(3, np.bool_))
    rate.reset(1)
    assert not rate.twist[1].any()
    extra = np.array([False, True, False])
    rate.update(*frames[4], poses, np.ones(3, np.bool_), extra)
    np.testing.assert_array_equal(rate.twist[[0, 2]], other.twist[[0, 2]])
    rate.update(*frames[5], poses, np.ones(3, np.bool_))
    other.update(*frames[5], poses, np.ones(3, np.bool_))
    np.testing.assert_array_equal(rate.twist[[0, 2]], other.twist[[0, 2]])
    fresh = SeamRate(1, DT)
    for p, d in frames[4:]:
        fresh.update(p[1:2], d[1:2], poses[:1], SEEN)
    np.testing.assert_array_equal(rate.twist[1], fresh.twist[0])
