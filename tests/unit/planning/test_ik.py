"""The closed-form inverse kinematics against the forward kinematics."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.core.frames import transform
from seal_gym.core.kinematics import DH_D, tip_kinematics
from seal_gym.planning import ik

N = 10_000
START = np.radians([-4.0, -117.8, -94.7, -102.4, 87.2, -92.8])


def forward(q):
    return tip_kinematics(q, np.zeros_like(q)).pose


def wrapped(angle):
    return np.abs(np.angle(np.exp(1j * angle)))


def errors(poses, solutions):
    """How far each finite row misses its pose, and which rows are finite. (N, 4, 4), (N, 8, 6)."""
    finite = np.isfinite(solutions).all(axis=-1)
    wanted = np.broadcast_to(poses[:, None], (*finite.shape, 4, 4))[finite]
    return np.abs(forward(solutions[finite]) - wanted).max(axis=(1, 2)), finite


@pytest.fixture(scope="module")
def postures():
    return np.random.default_rng(4).uniform(-np.pi, np.pi, (N, 6))


@pytest.fixture(scope="module")
def solutions(postures):
    return ik.solve(forward(postures))


def test_every_solution_reaches_its_pose(postures, solutions):
    assert solutions.shape == (N, ik.BRANCHES, 6)
    error, finite = errors(forward(postures), solutions)
    assert error.max() < 1e-9
    assert finite.any(axis=1).all()
    # A row is a posture or nothing.
    np.testing.assert_array_equal(np.isnan(solutions).all(axis=-1), ~finite)
    assert finite.all(axis=1).mean() > 0.5


def test_the_posture_itself_is_among_the_branches(postures, solutions):
    apart = wrapped(solutions - postures[:, None]).max(axis=-1)
    assert np.nanmin(apart, axis=1).max() < 1e-8


def test_angles_lie_within_half_a_turn(solutions):
    finite = solutions[np.isfinite(solutions)]
    assert finite.min() >= -np.pi
    assert finite.max() < np.pi


def test_branches_differ(solutions):
    full = solutions[np.isfinite(solutions).all(axis=(1, 2))]
    apart = wrapped(full[:, :, None] - full[:, None]).max(axis=-1)
    apart[:, np.arange(ik.BRANCHES), np.arange(ik.BRANCHES)] = np.inf
    # Branches meet at singularities only, and few random postures are near one.
    assert np.quantile(apart.min(axis=(1, 2)), 0.01) > 1e-2


def test_branch_bits_are_wrist_and_elbow_signs(solutions):
    full = solutions[np.isfinite(solutions).all(axis=(1, 2))]
    branch = np.arange(ik.BRANCHES)
    elbow, wrist = np.where(branch & 1, -1, 1), np.where(branch & 2, -1, 1)
    assert (np.sign(full[..., 2]) == elbow).all()
    assert (np.sign(full[..., 4]) == wrist).all()


def test_a_branch_follows_a_motion_without_jumps():
    s = np.linspace(0, 1, 400)[:, None]
    q = START + 0.3 * np.sin(2 * np.pi * s * np.arange(1, 7) / 6)
    branch = ik.solve(forward(q))[:, 5]
    np.testing.assert_allclose(branch, q, rtol=0, atol=1e-9)


def test_shapes_follow_the_poses_and_batches_equal_singles(postures):
    poses = forward(postures[:12])
    batch = ik.solve(poses)
    np.testing.assert_array_equal(ik.solve(poses.reshape(3, 4, 4, 4)), batch.reshape(3, 4, 8, 6))
    np.testing.assert_allclose(ik.solve(poses[5]), batch[5], rtol=0, atol=1e-12)


def test_another_tool():
    rng = np.random.default_rng(5)
    tool = transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3))
    q = np.tile(START, (1, 1))
    pose = tip_kinematics(q, np.zeros_like(q), tool).pose
    found = ik.nearest(ik.solve(pose, tool), START)
    np.testing.assert_allclose(found, q, rtol=0, atol=1e-9)


OUT_OF_REACH = {
    "too far": transform(np.eye(3), np.array([2.0, 0.0, 0.0])),
    "too high": transform(np.eye(3), np.array([0.2, 0.0, 1.8])),
    # The wrist's centre nearer to joint 1's axis than the offset of the wrist.
    "on the column": transform(np.eye(3), np.array([0.05, 0.0, 0.3 - 0.25 - DH_D[5]])),
}


@pytest.mark.parametrize("pose", OUT_OF_REACH.values(), ids=OUT_OF_REACH.keys())
def test_out_of_reach_is_nan_and_nothing_else_is(pose):
    assert np.isnan(ik.solve(pose)).all()
    assert np.isnan(ik.nearest(ik.solve(pose), START)).all()
    # Beside a pose within reach it spoils nothing.
    poses = np.stack((forward(START[None])[0], pose))
    found = ik.nearest(ik.solve(poses), START)
    np.testing.assert_allclose(found[0], START, rtol=0, atol=1e-9)
    assert np.isnan(found[1]).all()


def test_a_pose_on_the_axis_of_joint_one_is_out_of_reach():
    # Exactly on the axis the radius is 0: a division by zero inside, NaN outside, and no warning.
    tip = transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.4]))
    assert np.isnan(ik.solve(tip)).all()


@pytest.mark.parametrize("turns", [(0, 0, 0, 0, 0, 0), (1, -1, 0, 1, -1, 1), (-1, 0, 0, 0, 0, -1)])
def test_nearest_unwraps_to_the_reference(turns):
    reference = START + 2 * np.pi * np.array(turns)
    found = ik.nearest(ik.solve(forward(START[None])), reference + 0.05)
    np.testing.assert_allclose(found[0], reference, rtol=0, atol=1e-9)


def test_nearest_is_the_closest_of_all_branches(postures, solutions):
    apart = wrapped(solutions - START)
    closest = np.nanmin(np.sum(apart**2, axis=-1), axis=1)
    found = ik.nearest(solutions, START)
    np.testing.assert_allclose(np.sum((found - START) ** 2, axis=1), closest, rtol=1e-12)
    assert np.abs(found - START).max() <= np.pi + 1e-12
    error, _ = errors(forward(postures), found[:, None])
    assert error.max() < 1e-9


@pytest.mark.parametrize("q5", [0.0, np.pi])
def test_singular_wrist_still_reaches_the_pose(q5):
    # Joints 4 and 6 are parallel: the pose fixes their sum (q5 = 0) only, so the posture cannot come back.
    q = np.random.default_rng(6).uniform(-np.pi, np.pi, (500, 6))
    q[:, 4], q[:, 5] = q5, 0.0
    poses = forward(q)
    found = ik.solve(poses)
    error, finite = errors(poses, found)
    # cos q5 carries q5 to the square root of the rounding only.
    assert error.max() < 1e-9
    singular = finite & (np.abs(np.sin(found[..., 4])) < 1e-6)
    assert singular.any(axis=1).mean() > 0.9


@pytest.mark.parametrize("q5", [1e-3, -1e-3, 1e-5, np.pi - 1e-5])
def test_near_the_singular_wrist_the_posture_comes_back(q5):
    q = np.random.default_rng(7).uniform(-np.pi, np.pi, (500, 6))
    q[:, 4] = q5
    found = ik.solve(forward(q))
    error, _ = errors(forward(q), found)
    assert error.max() < 1e-8
    apart = wrapped(found - q[:, None]).max(axis=-1)
    assert np.quantile(np.nanmin(apart, axis=1), 0.95) < 1e-6
