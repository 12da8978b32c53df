"""The way to a hover: its ends by the forward kinematics, its rates by differences and against the limits."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import transform
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_SPEED, JOINT_UPPER, tip_kinematics
from seal_gym.planning.approach import ApproachCfg, plan_approach

HOME = np.radians([-60.0, -90.0, -60.0, -120.0, 90.0, 0.0])
START = np.radians([-4.0, -117.8, -94.7, -102.4, 87.2, -92.8])
RATE = load_cell().timing.frame_rate_hz


def forward(q):
    return tip_kinematics(q, np.zeros_like(q)).pose


@pytest.fixture(scope="module")
def hover():
    return forward(START[None])[0]


@pytest.fixture(scope="module")
def approach(hover):
    return plan_approach(HOME, hover)


def test_it_goes_from_home_to_the_hover_and_rests(approach, hover):
    np.testing.assert_allclose(approach.q[0], HOME, atol=1e-14)
    np.testing.assert_allclose(forward(approach.q[-1:])[0], hover, atol=1e-12)
    for rate in (approach.qd, approach.qdd):
        np.testing.assert_allclose(rate[[0, -1]], 0.0, atol=1e-12)


def test_it_comes_at_the_control_rate_and_ends_within_a_frame(approach):
    np.testing.assert_allclose(np.diff(approach.time_s), 1 / RATE)
    assert 0.0 <= approach.time_s[-1] - approach.duration_s < 1 / RATE
    assert approach.q.shape == approach.qd.shape == (len(approach.time_s), 6)


def test_the_arm_is_never_asked_for_more_than_it_has(approach):
    share = ApproachCfg().speed_share
    assert (np.abs(approach.qd) <= share * JOINT_SPEED * (1 + 1e-12)).all()
    assert np.abs(approach.qdd).max() <= load_cell().limits.joint_rad_s2
    assert ((approach.q >= JOINT_LOWER) & (approach.q <= JOINT_UPPER)).all()
    # Differences of the commands are the rates between them.
    assert (np.abs(np.diff(approach.q, axis=0)) * RATE <= share * JOINT_SPEED).all()
    assert np.abs(np.diff(approach.qdd, axis=0)).max() * RATE <= ApproachCfg().jerk_rad_s3


def test_rates_are_those_of_the_angles(approach):
    # Trapezoids of 1/30 s; their error is jerk x step^2 / 12 a second.
    moved = np.cumsum((approach.qd[1:] + approach.qd[:-1]) / 2 / RATE, axis=0)
    np.testing.assert_allclose(approach.q[1:] - HOME, moved, atol=150.0 / RATE**2 / 12)
    np.testing.assert_allclose(np.gradient(approach.qd, 1 / RATE, axis=0)[1:-1], approach.qdd[1:-1], atol=0.5)


def test_half_the_speed_takes_twice_the_time_where_speed_decides(hover):
    slow, slower = (plan_approach(HOME, hover, cfg=ApproachCfg(speed_share=s)).duration_s for s in (0.2, 0.1))
    assert slower == pytest.approx(2 * slow)


def test_a_batch_waits_for_its_longest_and_equals_singles(hover):
    far = plan_approach(HOME, hover)
    near_pose = forward(HOME[None] + 0.05)[0]
    near = plan_approach(HOME, near_pose)
    both = plan_approach(HOME, np.stack((hover, near_pose)))
    assert near.duration_s < far.duration_s
    np.testing.assert_array_equal(both.q[0], far.q)
    np.testing.assert_array_equal(both.q[1, : len(near.q)], near.q)
    np.testing.assert_allclose(both.q[1, len(near.q) :] - near.q[-1], 0.0, atol=1e-15)


def test_where_it_is_already_there_is_nothing_to_do(hover):
    q = plan_approach(START, hover).q
    np.testing.assert_allclose(q, np.broadcast_to(START, q.shape), atol=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plan_approach(HOME, transform(np.eye(3), np.array([2.0, 0, 0]))), "out of the arm's reach"),
        (lambda: plan_approach(np.full(6, 7.0), np.eye(4)), "home_q"),
        (lambda: ApproachCfg(speed_share=1.5), "speed_share = 1.5"),
        (lambda: ApproachCfg(k=0.4), "k = 0.4"),
        (lambda: ApproachCfg(jerk_rad_s3=0.0), "jerk_rad_s3"),
    ],
)
def test_what_cannot_be_is_refused(call, message):
    with pytest.raises(ConfigError, match=message):
        call()
