"""Rotations and transforms against scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import (
    axis_angle,
    cross,
    normalise,
    quat_from_matrix,
    tip_rotation,
    transform,
    yaw_pose,
)

RNG = np.random.default_rng(0)


def test_normalise_and_cross():
    v, w = RNG.normal(size=(2, 5, 4, 3))
    np.testing.assert_allclose(np.linalg.norm(normalise(v), axis=-1), 1.0)
    np.testing.assert_allclose(normalise(v) * np.linalg.norm(v, axis=-1, keepdims=True), v)
    np.testing.assert_allclose(cross(v, w), np.cross(v, w), atol=1e-15)
    np.testing.assert_allclose(cross(v, w[0, 0]), np.cross(v, w[0, 0]), atol=1e-15)


def test_axis_angle_is_scipys():
    axis, angle = normalise(RNG.normal(size=(50, 3))), RNG.uniform(-7, 7, 50)
    expected = Rotation.from_rotvec(axis * angle[:, None]).as_matrix()
    np.testing.assert_allclose(axis_angle(axis, angle), expected, atol=1e-14)
    np.testing.assert_allclose(axis_angle(axis[0], angle[0]), expected[0], atol=1e-14)


def test_transform_and_yaw_pose():
    rotation, position = Rotation.random(4, random_state=1).as_matrix(), RNG.normal(size=(4, 3))
    out = transform(rotation, position)
    point = RNG.normal(size=3)
    expected = rotation @ point + position
    np.testing.assert_allclose((out @ np.append(point, 1.0))[:, :3], expected, atol=1e-15)
    np.testing.assert_array_equal(out[:, 3], np.tile([0, 0, 0, 1], (4, 1)))
    pose = yaw_pose(1.0, 2.0, 3.0, np.pi / 2)
    np.testing.assert_allclose(pose @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-15)


def test_tip_rotation():
    tangent = normalise(RNG.normal(size=(20, 3)))
    approach = normalise(RNG.normal(size=(20, 3)))
    rotation = tip_rotation(tangent, approach)
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-13
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    np.testing.assert_allclose(rotation[:, :, 1], tangent)
    assert (np.sum(rotation[:, :, 2] * approach, axis=1) > 0).all()
    # Travel along y with the nozzle down: x is right of travel.
    np.testing.assert_allclose(tip_rotation(np.array([0, 1.0, 0]), np.array([0, 0, 1.0])), np.eye(3))
    with pytest.raises(ConfigError, match="parallel"):
        tip_rotation(np.array([0, 1.0, 0]), np.array([0, 1.0, 0]))


@pytest.mark.parametrize("axis", [0, 1, 2, None])
def test_quaternion_is_scipys_up_to_sign(axis):
    """Half turns about each axis make each of the four components the largest once."""
    turns = np.pi * np.eye(3)[[axis]] if axis is not None else RNG.uniform(-3, 3, (50, 3))
    for rotation in Rotation.from_rotvec(turns):
        q = quat_from_matrix(rotation.as_matrix())
        expected = rotation.as_quat()[[3, 0, 1, 2]]
        assert q[0] >= 0
        np.testing.assert_allclose(abs(q @ expected), 1.0, atol=1e-14)
