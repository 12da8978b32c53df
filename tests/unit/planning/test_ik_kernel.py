"""The compiled closed-form solution against pinocchio's forward kinematics and the numpy one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.core.frames import transform
from seal_gym.core.kinematics import DH_D, tip_kinematics
from seal_gym.planning import ik, ik_kernel


def misses(reached, wanted):
    """Distance [m] and angle [rad] between poses."""
    apart = np.linalg.norm(reached[:, :3, 3] - wanted[:, :3, 3], axis=1)
    chord = np.linalg.norm(reached[:, :3, :3] - wanted[:, :3, :3], axis=(1, 2))
    return apart, 2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1.0))


def test_every_branch_of_ten_thousand_reachable_poses_reaches_its_pose_in_pinocchio(reference_arm, reachable):
    _, poses = reachable
    solutions = ik_kernel.solve(poses)
    finite = np.isfinite(solutions).all(axis=-1)
    assert finite.any(axis=1).all()
    wanted = np.broadcast_to(poses[:, None], (*finite.shape, 4, 4))[finite]
    apart, angle = misses(reference_arm.tip(solutions[finite]), wanted)
    assert apart.max() < 1e-6
    assert angle.max() < 1e-6


def test_the_posture_itself_is_among_the_branches(reachable):
    q, poses = reachable
    apart = np.abs(np.angle(np.exp(1j * (ik_kernel.solve(poses) - q[:, None])))).max(axis=-1)
    assert np.nanmin(apart, axis=1).max() < 1e-6


def test_branches_are_the_numpy_solution_s(reachable):
    _, poses = reachable
    ours, theirs = ik_kernel.solve(poses), ik.solve(poses)
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))
    assert np.nanmax(np.abs(np.angle(np.exp(1j * (ours - theirs))))) < 1e-9
    assert np.nanmin(ours) >= -np.pi
    assert np.nanmax(ours) < np.pi


def test_shapes_follow_the_poses_and_batches_equal_singles(reachable):
    poses = reachable[1][:12]
    batch = ik_kernel.solve(poses)
    np.testing.assert_array_equal(ik_kernel.solve(poses.reshape(3, 4, 4, 4)), batch.reshape(3, 4, 8, 6))
    np.testing.assert_array_equal(ik_kernel.solve(poses[5]), batch[5])
    # A view that is not contiguous is read right too.
    np.testing.assert_array_equal(ik_kernel.solve(poses[::3]), batch[::3])


def test_another_tool():
    rng = np.random.default_rng(5)
    tool = transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3))
    q = rng.uniform(-3.0, 3.0, (50, 6))
    found = ik_kernel.solve(tip_kinematics(q, np.zeros_like(q), tool).pose, tool)
    assert np.nanmin(np.abs(found - q[:, None]).max(axis=-1), axis=1).max() < 1e-8


@pytest.mark.parametrize(
    "pose",
    [
        transform(np.eye(3), np.array([2.0, 0.0, 0.0])),
        transform(np.eye(3), np.array([0.05, 0.0, 0.05 - DH_D[5]])),
        transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.4])),
    ],
    ids=["too far", "on the column", "on the axis of joint 1"],
)
def test_out_of_reach_is_nan(pose):
    assert np.isnan(ik_kernel.solve(pose)).all()


@pytest.mark.parametrize(
    ("joint", "angle"), [(4, 0.0), (4, np.pi), (2, 0.0)], ids=["wrist", "turned", "elbow"]
)
def test_singular_poses_are_reached_from_rounded_poses(reference_arm, joint, angle):
    q = np.random.default_rng(7).uniform(-np.pi, np.pi, (2000, 6))
    q[:, joint] = angle
    poses = reference_arm.tip(q)
    found = ik_kernel.solve(poses)
    finite = np.isfinite(found).all(axis=-1)
    assert finite.any(axis=1).all()
    wanted = np.broadcast_to(poses[:, None], (*finite.shape, 4, 4))[finite]
    apart, turned = misses(reference_arm.tip(found[finite]), wanted)
    assert apart.max() < 1e-9
    assert turned.max() < 1e-9
