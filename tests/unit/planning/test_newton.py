"""Newton's inverse kinematics against pinocchio's forward kinematics."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import transform
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER, tip_kinematics
from seal_gym.planning import ik_kernel, newton
from seal_gym.planning.newton import NewtonCfg

START = np.radians([-4.0, -117.8, -94.7, -102.4, 87.2, -92.8])


def rng():
    return np.random.default_rng(1)


def forward(q):
    return tip_kinematics(q, np.zeros_like(q)).pose


@pytest.fixture(scope="module")
def solution(reachable):
    return newton.solve(reachable[1], START, rng())


def test_ten_thousand_reachable_poses_are_reached_in_pinocchio(reference_arm, reachable, solution):
    found = np.isfinite(solution.q).all(axis=1)
    reached = reference_arm.tip(solution.q[found])
    wanted = reachable[1][found]
    apart = np.linalg.norm(reached[:, :3, 3] - wanted[:, :3, 3], axis=1)
    chord = np.linalg.norm(reached[:, :3, :3] - wanted[:, :3, :3], axis=(1, 2))
    good = (apart < 1e-6) & (chord / np.sqrt(2) < 1e-6)
    assert good.sum() >= 0.999 * len(reachable[1])
    # What it calls found is.
    assert good.all()


def test_solutions_keep_to_the_limits_and_are_closed_form_branches(reachable, solution):
    found = solution.q
    kept = (found >= JOINT_LOWER) & (found <= JOINT_UPPER)
    assert (kept | np.isnan(found)).all()
    apart = np.abs(np.angle(np.exp(1j * (ik_kernel.solve(reachable[1]) - found[:, None])))).max(axis=-1)
    # Next to a singularity postures far apart share a pose to 1e-8.
    assert np.mean(np.nanmin(apart, axis=1) < 1e-4) > 0.99


@pytest.mark.parametrize(
    ("joint", "angle"), [(4, 0.0), (4, np.pi), (2, 0.0)], ids=["wrist", "turned", "elbow"]
)
def test_singular_poses_are_reached(reference_arm, joint, angle):
    q = np.random.default_rng(7).uniform(JOINT_LOWER, JOINT_UPPER, (500, 6))
    q[:, joint] = angle
    poses = reference_arm.tip(q)
    found = newton.solve(poses, START, rng()).q
    np.testing.assert_allclose(reference_arm.tip(found), poses, atol=1e-6)


def test_the_same_generator_gives_the_same_postures(reachable, solution):
    np.testing.assert_array_equal(newton.solve(reachable[1], START, rng()).q, solution.q)


def test_from_next_to_the_solution_it_takes_a_few_newton_steps(reachable):
    q = reachable[0][:1000]
    singular = np.linalg.svd(tip_kinematics(q, np.zeros_like(q)).jacobian, compute_uv=False)[:, -1]
    q = q[singular > 0.05]
    assert len(q) > 300
    found = newton.solve(forward(q), q + 0.01, rng())
    assert found.iterations.max() <= 5
    assert (found.restarts == 0).all()
    np.testing.assert_allclose(forward(found.q), forward(q), atol=2e-8)


def test_at_the_target_it_stays(reachable):
    q = reachable[0][:50]
    found = newton.solve(forward(q), q, rng())
    np.testing.assert_array_equal(found.q, q)
    np.testing.assert_array_equal(found.iterations, 0)


def test_out_of_reach_is_nan_and_beside_it_others_are_found():
    far = transform(np.eye(3), np.array([2.0, 0.0, 0.0]))
    targets = np.stack((far, forward(START[None])[0]))
    found = newton.solve(targets, START + 0.1, rng(), cfg=NewtonCfg(restarts=2))
    assert np.isnan(found.q[0]).all()
    np.testing.assert_array_equal(found.restarts, [2, 0])
    np.testing.assert_allclose(forward(found.q[1:])[0], targets[1], atol=1e-7)


def test_narrow_limits_are_kept():
    narrow = np.array([0.6, 0.5, 0.5, 0.7, 0.6, 0.8])
    lower, upper = START - narrow, START + narrow
    q = np.random.default_rng(2).uniform(lower, upper, (500, 6))
    found = newton.solve(forward(q), START, rng(), lower=lower, upper=upper).q
    assert np.isfinite(found).all()
    assert ((found >= lower) & (found <= upper)).all()
    np.testing.assert_allclose(forward(found), forward(q), atol=1e-7)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"position_m": 0.0}, "position_m = 0.0"),
        ({"damping": -1.0}, "damping"),
        ({"iterations": 0}, "at least 1"),
        ({"restarts": 1.5}, "whole number"),
    ],
)
def test_settings_are_checked(options, message):
    with pytest.raises(ConfigError, match=message):
        NewtonCfg(**options)


def test_crossed_limits_are_refused():
    with pytest.raises(ConfigError, match="in this order"):
        newton.solve(forward(START[None]), START, rng(), lower=JOINT_UPPER, upper=JOINT_LOWER)
