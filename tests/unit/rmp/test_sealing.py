"""The leaves together, in closed loop: a body frame that follows a straight seam at 30 Hz."""

from dataclasses import replace

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.rmp import (
    AttractionCfg,
    DampingCfg,
    SealingCfg,
    SeamErrors,
    axis_errors,
    fixed_policies,
    on_tip,
    reference_twist,
    resolve,
    seam_policies,
)

DT = 1 / 30
V_REF = 0.01
UNIT, NO_DRIFT = np.eye(6)[None], np.zeros((1, 6))


def rotation(vector):
    """Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    if angle < 1e-15:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def observe(position, frame, seam_offset):
    """Errors of a seam along the world's y axis through ``seam_offset``, from a tip pose."""
    direction = frame.T @ [0.0, 1.0, 0.0]
    point = frame.T @ (seam_offset - position)
    point -= direction * point[1] / direction[1]  # where the seam crosses the tip's x-z plane
    values = (
        point[0],
        np.arctan2(direction[0], direction[1]),
        point[2],
        np.arctan2(direction[2], direction[1]),
        np.arctan2(frame[2, 0], frame[2, 2]),
    )
    return SeamErrors(*(np.array([value]) for value in values))


def follow(start=(0.0, 0.0, 0.0), angles=(0.0, 0.0, 0.0), cfg=None, seconds=4.0, seam_speed=0.0):
    """Integrates the tip (semi-implicit Euler) and returns position, twist and errors after each frame.

    Args:
        start: Initial position against the seam's reference [m].
        angles: Initial turns about z, x and y [rad].
        cfg: Leaves.
        seconds: Duration.
        seam_speed: Speed of the seam along the world's x [m/s].
    """
    cfg = cfg or SealingCfg()
    yaw, pitch, roll = angles
    frame = (
        rotation(np.array([0, 0, yaw])) @ rotation(np.array([pitch, 0, 0])) @ rotation(np.array([0, roll, 0]))
    )
    position, twist, accel, seam = np.array(start), np.zeros((1, 6)), np.zeros((1, 6)), np.zeros(3)
    rows = []
    for _ in range(round(seconds / DT)):
        errors = observe(position, frame, seam)
        seam_twist = np.concatenate([frame.T @ [seam_speed, 0.0, 0.0], np.zeros(3)])[None]
        reference = reference_twist(V_REF, seam_twist)
        policies = seam_policies(errors, twist, reference, cfg)
        policies += fixed_policies(errors, twist, reference, accel, cfg)
        accel = resolve([on_tip(*policy, UNIT, NO_DRIFT) for policy in policies], UNIT)
        twist = twist + DT * accel
        position = position + DT * frame @ twist[0, :3]
        frame = frame @ rotation(DT * twist[0, 3:])
        seam = seam + DT * np.array([seam_speed, 0.0, 0.0])
        rows.append(np.concatenate([position - seam, twist[0], np.ravel(observe(position, frame, seam))]))
    return np.array(rows)


def test_the_task_is_met_from_a_start_beside_above_and_turned():
    path = follow(start=(5e-3, 0.0, 12e-3), angles=(np.radians(5), 0.0, 0.0))
    overshoot = -path[:, [0, 2]].min(axis=0)
    assert np.all(overshoot < 0.1e-3), "the nozzle has 1.06 mm; the task allows 0.8"
    after_a_second = path[30:]
    assert np.abs(after_a_second[:, [0, 2]]).max() < 0.02e-3
    np.testing.assert_allclose(after_a_second[:, 4], V_REF, rtol=1e-2)
    assert np.abs(np.degrees(path[-30:, [10, 12]])).max() < 0.01


@pytest.mark.parametrize("x", [-5e-3, 5e-3])
@pytest.mark.parametrize("yaw", [-0.3, 0.3])
@pytest.mark.parametrize("pitch", [-0.1, 0.1])
def test_every_sign_converges(x, yaw, pitch):
    path = follow(start=(x, 0.0, 0.012), angles=(yaw, pitch, 0.1))
    assert np.abs(path[-1, [0, 2]]).max() < 1e-6
    assert np.abs(path[-1, [10, 12]]).max() < 1e-4
    assert abs(path[-1, 13]) < 0.1 * 0.1, "the lean returns, slowly"
    assert path[:, 2].min() > -0.1e-3
    assert (np.sign(x) * path[:, 0]).min() > -0.5e-3


@pytest.mark.parametrize("axis", [0, 2, "yaw", "pitch"])
def test_small_errors_see_the_second_order_response(axis):
    """The same samples as x'' = -omega^2 x - 2 zeta omega x' with omega 12 and zeta 0.7, to 4 %."""
    size = 1e-5
    if axis == "yaw":
        response = follow(angles=(size, 0.0, 0.0))[:, 10]
    elif axis == "pitch":
        response = -follow(angles=(0.0, size, 0.0))[:, 12]
    else:
        response = follow(start=size * np.eye(3)[axis])[:, axis]
    x, v, ideal = size, 0.0, []
    for _ in response:
        v += DT * (-(12.0**2) * x - 2 * 0.7 * 12.0 * v)
        x += DT * v
        ideal.append(x)
    assert np.abs(response - ideal).max() < 0.04 * size


def test_approach_speed_and_acceleration_are_bounded():
    cfg = SealingCfg()
    path = follow(start=(0.1, 0.0, 0.2), seconds=6.0)
    limit = cfg.attraction.max_rate
    assert np.abs(path[:, [3, 5]]).max() <= 1.001 * limit
    accel = np.diff(path[:, [3, 5]], axis=0) / DT
    assert np.abs(accel).max() <= 1.1 * cfg.attraction.damping_s * limit


def test_a_moving_seam_is_followed_without_lag():
    path = follow(seam_speed=0.004)
    assert np.abs(path[30:, 0]).max() < 1e-5


def test_tuned_is_consistent_and_slower():
    slow = SealingCfg.tuned(6.0)
    assert slow.attraction.damping_s == pytest.approx(slow.damping.damping_s)
    assert slow.lean.damping_s == pytest.approx(slow.damping.damping_s)
    assert SealingCfg.tuned(12.0).attraction == AttractionCfg()
    start = (1e-4, 0.0, 0.0)
    assert follow(start=start, cfg=slow)[10, 0] > follow(start=start)[10, 0]


def test_axis_errors_carry_the_signs_of_the_motion_that_removes_them():
    errors = SeamErrors(*np.arange(1.0, 6.0)[:, None])
    np.testing.assert_array_equal(axis_errors(errors), [[1.0, 0.0, 3.0, 4.0, 5.0, -2.0]])


def test_reference_adds_the_seam_and_leaves_its_argument_alone():
    seam = np.ones((2, 6))  # rad/s: slow enough for the full speed
    reference = reference_twist(np.array([0.1, 0.2]), seam)
    np.testing.assert_array_equal(reference[:, 1], [1.1, 1.2])
    np.testing.assert_array_equal(seam, np.ones((2, 6)))


@pytest.mark.parametrize(("turn", "share"), [(0.0, 1.0), (1.6, 1.0), (2.0, 0.5), (2.4, 0.0), (9.0, 0.0)])
@pytest.mark.parametrize("axis", [3, 5])
def test_travel_slows_down_where_the_seam_turns_fast(turn, share, axis):
    seam = np.zeros((1, 6))
    seam[0, axis], seam[0, 1] = -turn, 0.003
    np.testing.assert_allclose(reference_twist(0.01, seam)[0, 1], 0.003 + 0.01 * share, atol=1e-15)


def test_travel_round_a_corner_of_5_mm_settles_where_rule_and_geometry_meet():
    """The seam turns at v / r, and v = v_ref (1 - 2 (v / r / 1.6 - 1)): 8.6 mm/s instead of 10."""
    speed, seam = 0.01, np.zeros((1, 6))
    for _ in range(200):
        seam[0, 5] += 0.2 * (speed / 0.005 - seam[0, 5])  # the rate is known a little late
        speed = reference_twist(0.01, seam)[0, 1]
    assert speed == pytest.approx(0.03 / 3.5, rel=1e-6)


def test_a_batch_gives_the_bits_of_its_members():
    rng = np.random.default_rng(0)
    features, twist, accel = rng.normal(size=(17, 5)) * 0.01, *rng.normal(size=(2, 17, 6)) * 0.05

    def accelerations(rows):
        errors = SeamErrors(*features[rows].T)  # strided, as features of a batch are
        reference = reference_twist(V_REF, np.zeros_like(twist[rows]))
        policies = seam_policies(errors, twist[rows], reference)
        policies += fixed_policies(errors, twist[rows], reference, accel[rows])
        jacobian = np.broadcast_to(np.eye(6), (len(features[rows]), 6, 6))
        drift = np.zeros_like(twist[rows])
        return resolve([on_tip(*policy, jacobian, drift) for policy in policies], jacobian)

    batch = accelerations(slice(None))
    for i in range(17):
        np.testing.assert_array_equal(accelerations(slice(i, i + 1))[0], batch[i])


def test_mismatched_damping_is_refused():
    with pytest.raises(ConfigError, match=r"attraction\.damping_weight"):
        SealingCfg(damping=DampingCfg(weight=0.5))
    attraction = replace(AttractionCfg(), damping_weight=0.5)
    with pytest.raises(ConfigError, match=r"heading\.damping_weight is 0\.25 but damping\.weight is 0\.5"):
        SealingCfg(attraction=attraction, damping=DampingCfg(weight=0.5))
