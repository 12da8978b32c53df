"""Whole turns of joints and the closest branch within limits."""

import numpy as np

from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER
from seal_gym.planning import ik, ik_kernel

START = np.radians([-4.0, -117.8, -94.7, -102.4, 87.2, -92.8])


def test_within_turns_joints_back_and_else_stops_them():
    lower, upper = np.array([-4.0, -1.0, -4.0, 1.0]), np.array([4.0, 1.0, 4.0, 9.0])
    q = np.array([4.5, 1.5, -4.5, 0.5])
    expected = [4.5 - 2 * np.pi, 1.0, -4.5 + 2 * np.pi, 0.5 + 2 * np.pi]
    np.testing.assert_allclose(ik.within(q, lower, upper), expected)
    np.testing.assert_array_equal(ik.within(lower, lower, upper), lower)


def test_every_reachable_pose_has_a_branch_within_the_limits(reference_arm, reachable):
    _, poses = reachable
    found = ik.nearest_within(ik_kernel.solve(poses), START)
    assert ((found >= JOINT_LOWER) & (found <= JOINT_UPPER)).all()
    np.testing.assert_allclose(reference_arm.tip(found), poses, atol=1e-8)


def test_it_is_the_closest_of_all_turns_of_all_branches(reachable):
    solutions = ik_kernel.solve(reachable[1][:300])
    # Every joint at every whole turn, by hand: the closest each joint alone allows.
    turns = 2 * np.pi * np.arange(-2, 3)
    every = solutions[..., None] + turns
    outside = (every < JOINT_LOWER[:, None]) | (every > JOINT_UPPER[:, None])
    apart = (
        np.where(outside | np.isnan(every), np.inf, (every - START[:, None]) ** 2).min(axis=-1).sum(axis=-1)
    )
    found = ik.nearest_within(solutions, START)
    np.testing.assert_allclose(np.sum((found - START) ** 2, axis=-1), apart.min(axis=1), rtol=1e-9)


def test_where_no_branch_fits_it_is_nan(reachable):
    solutions = ik_kernel.solve(reachable[1][:300])
    lower, upper = START - 0.5, START + 0.5
    fits = ((ik.nearest_within(solutions, START) - START) ** 2).max(axis=-1) < 0.25
    found = ik.nearest_within(solutions, START, lower, upper)
    np.testing.assert_array_equal(np.isfinite(found).all(axis=-1), fits)
    assert np.isnan(ik.nearest_within(np.full((8, 6), np.nan), START)).all()
    near = ik.nearest_within(START + np.linspace(0.1, 0.8, 8)[:, None], START, lower, upper)
    np.testing.assert_allclose(near, START + 0.1)
