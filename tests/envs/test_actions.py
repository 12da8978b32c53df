"""What an action does to the arm, measured on the physics."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ActionError, ConfigError, SealGymError
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_SPEED, JOINT_UPPER, tip_kinematics
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.rmp import Leaf, cholesky_metric, on_tip

DT = 1 / 30
SUBSTEP = DT / 8
TWIST = slice(11, 17)  # of the observation, mm/s and deg/s
SCALE = np.array([1.0] * 3 + [25.0] * 3)


def push(env, action, steps, seed=0):
    """Twist of the tip (SI) after some steps of an action, and where the tip went in its first frame."""
    env.reset(seed=seed)
    core = env.unwrapped.core
    start = core.tip.pose[0].copy()
    for _ in range(steps):
        observation, *_ = env.step(action)
    twist = observation[TWIST] * np.array([1e-3] * 3 + [np.pi / 180] * 3)
    moved = start[:3, :3].T @ (core.tip.pose[0, :3, 3] - start[:3, 3])
    return twist, moved, start[:3, :3].T @ core.tip.pose[0, :3, :3]


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_tip_acceleration_is_realised_along_its_axis(make, axis, sign):
    """From rest, 4 frames at a: the twist is a t on that axis, next to nothing on the others."""
    env = make(control="tip")
    level, steps = (0.1, 4) if axis < 3 else (0.02, 4)
    action = np.zeros(6, np.float32)
    action[axis] = sign * level
    twist, moved, turned = push(env, action, steps)
    time = steps * DT
    expected = np.zeros(6)
    expected[axis] = sign * level * SCALE[axis] * time
    # A turn moves the twist's linear part by the servo's lag only; lengths count as 0.25 m a radian.
    size = np.array([1.0] * 3 + [0.25] * 3)
    error = np.abs(size * (twist - expected)).max() / np.abs(size * expected).max()
    assert error < 0.03
    ahead = abs(expected[axis]) * SUBSTEP  # the servo may be a physics step ahead
    if axis < 3:
        assert moved[axis] == pytest.approx(0.5 * expected[axis] * time, abs=ahead)
        assert np.abs(np.delete(moved, axis)).max() < 0.03 * abs(moved[axis])
    else:
        angle = np.arccos((np.trace(turned) - 1) / 2)
        assert angle == pytest.approx(abs(0.5 * expected[axis] * time), abs=ahead)
        assert np.linalg.norm(moved) < 0.03 * 0.25 * angle


@pytest.mark.parametrize("joint", range(6))
def test_joint_acceleration_is_realised(make, joint):
    env = make(control="joint")
    action = np.zeros(6, np.float32)
    action[joint] = 4.0 / 15.0
    env.reset(seed=0)
    q = env.unwrapped.core.arm.q[0].copy()
    for _ in range(3):
        observation, *_ = env.step(action)
    speed, angle = 4.0 * 3 * DT, 0.5 * 4.0 * (3 * DT) ** 2
    expected = speed * np.eye(6)[joint]
    np.testing.assert_allclose(observation[29:35], expected, atol=0.03 * speed)
    np.testing.assert_allclose(observation[23:29] - q, angle * np.eye(6)[joint], atol=speed * SUBSTEP)


@pytest.mark.parametrize("control", ["tip", "rmp", "joint"])
def test_different_actions_from_the_same_state_end_differently(make, control):
    env = make(control=control)
    rng = np.random.default_rng(0)
    ends = []
    for _ in range(4):
        env.reset(seed=0)
        env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        ends.append(env.unwrapped.core.arm.q[0].copy())
    assert len(np.unique(ends, axis=0)) == 4


def test_every_entry_of_an_action_has_an_effect(make):
    for control in ("tip", "rmp", "joint"):
        env = make(control=control)
        base = np.full(env.action_space.shape, 0.3, np.float32)
        ends = []
        for k in range(-1, base.size):
            action = base.copy()
            if k >= 0:
                action[k] = 0.2
            env.reset(seed=0)
            env.step(action)
            ends.append(env.unwrapped.core.arm.qd_command[0].copy())
        assert (np.abs(np.array(ends[1:]) - ends[0]).max(axis=1) > 1e-9).all()


# -- rmp ----------------------------------------------------------------------------------------------------


def rmp_action(accel, factor):
    return np.concatenate((np.asarray(accel) / SCALE, factor[np.tril_indices(6)] / 2.0))


def command(make, action, **kwargs):
    env = make(control="rmp", **kwargs)
    env.reset(seed=0)
    env.step(action.astype(np.float32))
    return env.unwrapped.core.arm.qd_command[0] / DT


def test_equal_f_and_different_a_give_different_joint_accelerations(make):
    f = [0.3, 0.2, 0.3, 1.0, 0.5, 1.0]
    weak, strong = 0.1 * np.eye(6), np.eye(6)
    skewed = np.eye(6) + np.tril(np.full((6, 6), 0.5), -1)
    results = [command(make, rmp_action(f, factor)) for factor in (weak, strong, skewed)]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(results[a] - results[b]).max() > 0.05 * np.abs(results[b]).max()


def test_a_strong_policy_beats_the_fixed_leaves_and_a_weightless_one_changes_nothing(make):
    """With a growing metric the resolved tip acceleration nears f; with A = 0, f has no say."""
    f = np.array([0.2, 0.1, 0.2, 0.0, 0.0, 0.0])
    misses = []
    for size in (0.2, 0.6, 2.0):
        env = make(control="rmp")
        env.reset(seed=0)
        q = env.unwrapped.core.arm.q_command.copy()
        env.step(rmp_action(f, size * np.eye(6)).astype(np.float32))
        qdd = env.unwrapped.core.arm.qd_command / DT
        twist_rate = (tip_kinematics(q, 0 * q).jacobian @ qdd[:, :, None])[0, :, 0]
        misses.append(np.linalg.norm((twist_rate - f)[:3]))
    assert misses[0] > misses[1] > misses[2]
    nothing = np.zeros((6, 6))
    np.testing.assert_array_equal(
        command(make, rmp_action(f, nothing)), command(make, rmp_action(-f, nothing))
    )


def lift(state):
    """Up and away from the part, strongly."""
    n = len(state.q)
    accel = np.tile([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], (n, 1))
    metric = np.tile(10.0 * np.eye(6), (n, 1, 1))
    return on_tip(accel, metric, state.tip.jacobian, state.tip.drift)


def test_a_leaf_added_at_run_time_changes_the_motion(make):
    plain, lifted = make(control="rmp"), make(control="rmp")
    action = np.zeros(27, np.float32)
    for env in (plain, lifted):
        env.reset(seed=0)
        for _ in range(3):
            env.step(action)
    np.testing.assert_array_equal(plain.unwrapped.core.arm.q, lifted.unwrapped.core.arm.q)
    lifted.unwrapped.add_leaf(lift)
    before = lifted.unwrapped.core.tip.pose[0].copy()
    for _ in range(3):
        plain.step(action)
        lifted.step(action)
    core = lifted.unwrapped.core
    up = before[:3, :3].T @ (core.tip.pose[0, :3, 3] - before[:3, 3])
    assert up[2] == pytest.approx(0.5 * 0.5 * (3 * DT) ** 2, rel=0.15)
    assert core.tip.pose[0, 2, 3] > plain.unwrapped.core.tip.pose[0, 2, 3] + 1e-3


def test_a_leaf_given_as_an_argument_is_the_same_as_one_added(make):
    given, added = make(control="rmp", leaves=[lift]), make(control="rmp")
    added.unwrapped.add_leaf(lift)
    action = np.full(27, 0.1, np.float32)
    for env in (given, added):
        env.reset(seed=0)
    for _ in range(4):
        np.testing.assert_array_equal(given.step(action)[0], added.step(action)[0])


def test_a_leaf_sees_the_state_and_the_parts_pose(make):
    seen = []

    def watch(state):
        seen.append(state)
        return Leaf(np.eye(6)[None], np.zeros((1, 6)), np.zeros((1, 6)), np.zeros((1, 6, 6)))

    env = make(control="rmp", leaves=[watch])
    env.reset(seed=0)
    core = env.unwrapped.core
    part = core.arm.part_pose.copy()
    env.step(np.zeros(27, np.float32))
    np.testing.assert_array_equal(seen[0].part_pose, part)
    assert seen[0].q.shape == (1, 6) and not seen[0].qd.any()
    assert seen[0].errors.d_side_m[0] < -5e-3


@pytest.mark.parametrize("control", ["tip", "joint"])
def test_leaves_are_refused_by_other_controls(make, control):
    with pytest.raises(ActionError, match="control='rmp'"):
        make(control=control).unwrapped.add_leaf(lift)


def test_cholesky_entries_are_row_by_row():
    factor = np.tril(np.arange(36.0).reshape(6, 6))
    np.testing.assert_allclose(cholesky_metric(factor[np.tril_indices(6)][None])[0], factor @ factor.T)


# -- limits -------------------------------------------------------------------------------------------------


def test_joint_and_speed_limits_hold_under_extreme_joint_actions():
    """Each joint full ahead both ways until its stop, and bang-bang at random; collisions do not matter."""
    core = SealCore(SealCfg(control="joint"), 16)
    for i in range(16):
        core.reset(i, np.random.default_rng(i))
    rng = np.random.default_rng(0)
    constant = np.concatenate((np.eye(6), -np.eye(6)))
    fastest = np.zeros(6)
    clear = np.ones(16, np.bool_)
    for k in range(110):
        if k % 8 == 0:
            bang = rng.choice([-1.0, 1.0], (4, 6))
        result = core.step(np.concatenate((constant, bang)))
        arm = core.arm
        assert (np.abs(arm.qd_command) <= JOINT_SPEED).all()
        assert (arm.q_command >= JOINT_LOWER).all() and (arm.q_command <= JOINT_UPPER).all()
        assert np.isfinite(arm.q).all() and np.isfinite(arm.qd).all()
        # The measured motion follows a single joint's command; six at full bang-bang saturate the torques.
        clear &= ~result.collision
        q, qd = arm.q[:12][clear[:12]], arm.qd[:12][clear[:12]]
        assert (np.abs(qd) <= 1.25 * JOINT_SPEED).all()
        assert (q >= JOINT_LOWER - 0.06).all() and (q <= JOINT_UPPER + 0.06).all()
        fastest = np.maximum(fastest, np.abs(arm.qd_command).max(axis=0))
    np.testing.assert_allclose(fastest, JOINT_SPEED)
    assert clear[:12].sum() >= 4
    for i in np.flatnonzero(clear[:12]):  # at the stop, and at rest there, unless something was in the way
        j = i % 6
        stop = JOINT_UPPER[j] if i < 6 else JOINT_LOWER[j]
        assert core.arm.q_command[i, j] == stop
        assert core.arm.qd_command[i, j] == 0.0


@pytest.mark.parametrize("control", ["tip", "rmp", "joint"])
def test_full_actions_keep_every_number_finite(control):
    """Through collisions and past an episode's end, in a batch."""
    core = SealCore(SealCfg(workpiece="rectangular", control=control), 8)
    for i in range(8):
        core.reset(i, np.random.default_rng(i))
    rng = np.random.default_rng(1)
    for _ in range(60):
        result = core.step(rng.choice([-1.0, 1.0], (8, core.adapter.size)))
        observation = core.observe()
        assert np.isfinite(observation).all() and np.isfinite(result.reward).all()
        assert (np.abs(result.reward) <= core.cfg.reward.bound).all()


def test_limits_come_from_the_cell():
    limits = load_cell().limits
    assert (limits.linear_m_s2, limits.angular_rad_s2, limits.joint_rad_s2) == (1.0, 25.0, 15.0)


# -- what users get wrong -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "action", ["fast", ["0"] * 6, {}, None, np.zeros(6, complex), [[0.0], 1, 2], np.zeros((1, 6))]
)
def test_an_action_that_is_none_is_refused(make, action):
    env = make(control="tip")
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"takes numbers of shape \(6,\)"):
        env.unwrapped.step(action)


def test_an_outcome_is_paid_once(make):
    env = make(control="tip")
    env.reset(seed=0)
    down, done = np.array([0, 0, -1, 0, 0, 0], np.float32), False
    while not done:
        _, reward, terminated, truncated, _ = env.step(down)
        done = terminated or truncated
    assert reward < -15
    assert [env.step(down)[1] for _ in range(3)] == [0.0] * 3
    env.reset()
    assert env.step(down)[1] != 0.0


def test_a_leaf_that_goes_wrong_is_named(make):
    def broken(state):
        n = len(state.q)
        return Leaf(
            np.tile(np.eye(6), (n, 1, 1)), np.zeros((n, 6)), np.full((n, 6), np.nan), np.zeros((n, 6, 6))
        )

    env = make(control="rmp")
    with pytest.raises(ConfigError, match="leaf = 3: must be a function"):
        env.unwrapped.add_leaf(3)
    env.reset(seed=0)
    q = env.unwrapped.core.arm.q.copy()
    for leaf, message in (
        (broken, "'broken' gave a value of accel that is not finite"),
        (lambda _: 1, "gave 1"),
    ):
        env.unwrapped.core.adapter.leaves[:] = [leaf]
        with pytest.raises(ActionError, match=message):
            env.step(np.zeros(27, np.float32))
    np.testing.assert_array_equal(env.unwrapped.core.arm.q, q)


@pytest.mark.parametrize(
    "kwargs", [{"reward": None}, {"look": 3}, {"task": {"reach_m": 1}}, {"cell": "x"}, {"leaves": None},
               {"leaves": (3,)}, {"workpiece": [1]}, {"sealant": 1}]
)  # fmt: skip
def test_arguments_of_a_wrong_type_are_named(kwargs):
    (name,) = kwargs
    with pytest.raises(SealGymError, match=rf"^(leaf|{name}) = "):
        SealCfg.of(**{"control": "rmp", **kwargs})
