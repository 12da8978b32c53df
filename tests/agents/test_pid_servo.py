import gymnasium as gym
import numpy as np
import pytest

import agents
import seal_gym  # noqa: F401  # registers the ids
from agents import pid_servo
from agents.pid_servo import LoopCfg, PidServo, PidServoCfg
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.envs.sb3 import make_sb3_vec

FRAME_S = 1.0 / 30.0
SCALE = np.array([1.0, 1.0, 1.0, 25.0, 25.0, 25.0])
# Feature's index, its unit, the axis of the tip it drives, the sign of the velocity that takes it away, and
# the seam's rate that belongs to it.
LOOPS = {
    "d_front": (0, 1e-3, 0, +1, 6),
    "d_side": (3, 1e-3, 2, +1, 7),
    "theta_side": (4, np.pi / 180, 3, +1, 8),
    "theta_front": (1, np.pi / 180, 5, -1, 9),
}
PLAIN = {"kp_s": 4.0, "ki_s2": 0.0, "kd": 0.25, "max_rate": 10.0}


def observation(**values):
    """Features of a tip at rest on the seam, with changes by index."""
    row = np.zeros(35, np.float32)
    row[[2, 5]] = 1.0
    for name, value in values.items():
        row[int(name[1:])] = value
    return row


def servo(speed_s=10.0, **gains):
    loop = LoopCfg(**{**PLAIN, **gains})
    cfg = PidServoCfg(d_front=loop, d_side=loop, theta_side=loop, theta_front=loop, speed_s=speed_s)
    return PidServo(cfg=cfg)


def accel(policy, row, state=None, start=None):
    action, after = policy.predict(row, state, start)
    return action.astype(float) * SCALE, after


def simulate(policy, loop, error, seconds, seam_rate=0.0, halt=None):
    """A double integrator on the axis of a loop: its errors, one a frame, in m or rad."""
    index, unit, axis, sign, rate = LOOPS[loop]
    velocity, state, errors, start = 0.0, None, [], np.array([True])
    for k in range(round(seconds / FRAME_S)):
        row = observation()
        row[index], row[11 + axis] = sign * error / unit, velocity / unit
        row[rate] = seam_rate / unit
        if halt is not None and halt(k):
            row[2] = 0.0
        a, state = accel(policy, row, state, start)
        errors.append(error)
        start = np.array([False])
        error += seam_rate * FRAME_S - FRAME_S * (velocity + 0.5 * FRAME_S * a[axis])
        velocity += FRAME_S * a[axis]
    return np.array(errors)


def exact(k, kp, ki, kd, error, frames):
    """The same by the matrix of one frame: error, velocity and integral term; A^n x0 by its eigenvectors."""
    p = kp + ki / kp
    h = FRAME_S
    # What is added to the integral term, then the acceleration, as rows over (e, v, J).
    grown = np.array([ki * h, 0.0, 1.0])
    a = k * (np.array([p, -kd, 0.0]) + grown - np.array([0.0, 1.0, 0.0]))
    step = np.stack((np.array([1.0, -h, 0.0]) - 0.5 * h * h * a, np.array([0.0, 1.0, 0.0]) + h * a, grown))
    values, vectors = np.linalg.eig(step)
    start = np.linalg.solve(vectors, np.array([error, 0.0, -ki / kp * error], complex))
    return np.array([(vectors @ (values**n * start))[0].real for n in range(frames)])


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("ki", [0.0, 3.0])
def test_on_a_double_integrator_the_response_is_the_closed_form(loop, ki):
    errors = simulate(servo(ki_s2=ki), loop, 1e-3, 3.0)
    np.testing.assert_allclose(errors, exact(10.0, 4.0, ki, 0.25, 1e-3, len(errors)), atol=2e-9)
    assert abs(errors[-1]) < 2e-5 < abs(errors[20])


def test_the_response_is_near_that_of_the_differential_equation():
    """Slow against a frame, it is e'' + k (1 + kd) e' + k kp e = 0 from rest: two real poles here."""
    k, kp, kd = 2.0, 0.5, 0.25
    errors = simulate(servo(k, kp_s=kp, kd=kd), "d_side", 1e-3, 6.0)
    fast, slow = np.roots([1.0, k * (1.0 + kd), k * kp])
    t = FRAME_S * np.arange(len(errors))
    wanted = 1e-3 * (slow * np.exp(fast * t) - fast * np.exp(slow * t)) / (slow - fast)
    np.testing.assert_allclose(errors, wanted, atol=1e-5)


def test_behind_a_moving_seam_it_lags_without_and_not_with_the_integral():
    seam = 2e-3
    lag = simulate(servo(), "d_front", 0.0, 5.0, seam_rate=seam)[-1]
    assert lag == pytest.approx(seam / 4.0, rel=1e-3)
    assert abs(simulate(servo(ki_s2=4.0), "d_front", 0.0, 12.0, seam_rate=seam)[-1]) < 1e-3 * lag


def test_velocity_and_integral_stay_bounded_and_an_approach_does_not_wind_up():
    """From far away at its bound for 2 s, the integral adds no overshoot to what there is without it."""
    bound = 0.01
    errors = {ki: simulate(servo(ki_s2=ki, max_rate=bound), "d_side", 0.02, 8.0) for ki in (0.0, 4.0)}
    speed = -np.diff(errors[4.0]) / FRAME_S
    assert speed.max() == pytest.approx(bound, rel=0.01)
    assert errors[4.0].min() > errors[0.0].min() - 1e-5
    assert abs(errors[4.0][-1]) < 1e-5
    # Integrated all the way, at 4 /s^2 the term would be 0.16 m/s by then: ten times the bound.
    _, state = servo(ki_s2=4.0, max_rate=bound).predict(observation(i3=20.0), np.full((1, 4), 0.5))
    assert abs(state[0, 1]) <= 4.0 / 4.0 * 0.02 + 1e-9


def test_a_bound_that_is_left_again_is_not_remembered():
    """Held at the bound for 1 s or for 10 s, the next frame is the same."""
    policy = servo(ki_s2=4.0, max_rate=0.01)
    far, near = observation(i0=8.0), observation(i0=1.0)
    after = []
    for frames in (30, 300):
        state = None
        for _ in range(frames):
            _, state = policy.predict(far, state)
        after.append(accel(policy, near, state)[0])
    np.testing.assert_array_equal(*after)


def test_each_feature_drives_its_own_axis():
    policy, rest = servo(), observation(i12=10.0)
    at_rest, _ = accel(policy, rest)
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-6)  # on the seam at speed
    for index, unit, axis, sign, _ in LOOPS.values():
        row = rest.copy()
        row[index] = 1.0
        change, _ = accel(policy, row)
        expected = np.zeros(6)
        expected[axis] = sign * 10.0 * 4.0 * unit
        if index in (1, 4):  # at an angle to the seam, travel at 10 mm/s moves it sideways: kd of that
            expected[{1: 0, 4: 2}[index]] = 10.0 * 0.25 * 0.010 * np.sin(unit)
        np.testing.assert_allclose(change, expected, rtol=1e-5, atol=1e-7)


def test_travel_is_fed_forward_and_the_lean_restored_as_by_the_fixed_leaves():
    a, _ = accel(servo(), observation())
    assert a[1] == pytest.approx(10.0 * 0.010, rel=1e-6)  # k (v_ref - 0)
    # Lean 0.1 (k sat(e) - c w), damping .25 (-c w), regularisation .05 (0).
    e = np.deg2rad(0.5)
    c = 2.0 * 2.1 * 4.0
    k = 4.0**2 * (1.0 + 0.25 / 0.1)
    limit = c * 0.3 / k
    damping = 0.25 * (1.0 - 0.8 / (1.0 + np.exp(-115.0 * (e - 0.035))))
    a, _ = accel(servo(), observation(i10=0.5))
    weight = 0.1 + damping + 0.05
    assert a[4] == pytest.approx(0.1 * k * limit * np.tanh(e / limit) / weight, rel=1e-4)


@pytest.mark.parametrize("flag", [2, 5])
def test_without_a_view_it_brakes_on_every_axis_and_the_integrals_wait(flag):
    row = observation(i0=3.0, i1=4.0, i3=-2.0, i4=1.0, i11=5.0, i12=10.0, i13=-4.0, i14=3.0, i16=-6.0)
    row[flag] = 0.0
    held = np.array([[1e-3, -2e-3, 3e-2, 4e-2]])
    a, state = accel(servo(ki_s2=4.0), row, held)
    twist = row[11:17] * np.repeat((1e-3, np.pi / 180), 3)
    axes = [0, 1, 2, 3, 5]
    np.testing.assert_allclose(a[axes], -10.0 * twist[axes], rtol=1e-5)
    np.testing.assert_array_equal(state, held)


def test_after_a_gap_it_goes_on_from_where_it_was():
    errors = simulate(servo(ki_s2=3.0), "d_front", 1e-3, 6.0, halt=lambda k: 20 <= k < 40)
    assert abs(errors[-1]) < 1e-5
    # During the gap the tip comes to rest: nothing moves any more.
    np.testing.assert_allclose(errors[36:40], errors[36], atol=5e-6)


def test_an_episode_starts_with_no_memory_and_the_state_given_is_left_alone():
    policy = servo(ki_s2=4.0)
    rows = np.stack([observation(i0=1.0), observation(i0=1.0)])
    fresh, first = policy.predict(rows)
    held = np.full((2, 4), 5e-4)
    before = held.copy()
    mixed, state = policy.predict(rows, held, np.array([True, False]))
    np.testing.assert_array_equal(held, before)
    np.testing.assert_array_equal(mixed[0], fresh[0])
    np.testing.assert_array_equal(state[0], first[0])
    assert mixed[1, 0] != fresh[1, 0]
    again, _ = policy.predict(rows)  # the object keeps nothing
    np.testing.assert_array_equal(again, fresh)


def test_single_and_vector_agree_to_the_bit():
    rng = np.random.default_rng(1)
    policy, rows = PidServo(), rng.normal(size=(7, 40, 35)).astype(np.float32)
    rows[:, :, [2, 5]] = rng.random((7, 40, 2)) < 0.9
    starts = rng.random((7, 40)) < 0.1
    state, actions = None, []
    for k in range(40):
        action, state = policy.predict({"features": rows[:, k]}, state, starts[:, k])
        actions.append(action)
    for i in range(7):
        alone = None
        for k in range(40):
            action, alone = policy.predict(rows[i, k], alone, starts[i, k : k + 1])
            assert action.shape == (6,)
            np.testing.assert_array_equal(action, actions[k][i])
        np.testing.assert_array_equal(alone[0], state[i])
    assert np.abs(actions).max() <= 1.0


@pytest.mark.parametrize("workpiece", ["flat", "cylinder", "rectangular"])
def test_it_reaches_the_end_of_each_part(workpiece):
    env = gym.make("SealGym/Seal-v0", workpiece=workpiece, control="tip", perception="oracle")
    policy = agents.load_policy("pid_servo", env)
    observed, _ = env.reset(seed=500_100)
    state, start, done = None, np.array([True]), False
    while not done:
        action, state = policy.predict(observed, state, start)
        observed, _, terminated, truncated, info = env.step(action)
        start, done = np.array([False]), terminated or truncated
    assert info["episode_metrics"]["outcome"] == "reached"
    assert info["episode_metrics"]["rmse_mm"] < 0.5


def test_in_a_vectorised_environment_rows_follow_the_single_one():
    single = gym.make("SealGym/Flat-v0", control="tip", perception="oracle")
    vector = make_sb3_vec("SealGym/Flat-v0", 2, control="tip", perception="oracle")
    policy = agents.load_policy("pid_servo", vector)
    vector.seed(7)
    rows, (row, _) = vector.reset(), single.reset(seed=8)
    states, state = None, None
    for _ in range(60):
        actions, states = policy.predict(rows, states)
        action, state = policy.predict(row, state)
        np.testing.assert_array_equal(actions[1], action)
        rows, *_ = vector.step(actions)
        row, *_ = single.step(action)
    vector.close()


def test_wrong_gains_shapes_and_control_modes_are_refused():
    with pytest.raises(ConfigError, match=r"LoopCfg\.kp_s = 0: must be a finite number > 0"):
        LoopCfg(kp_s=0, ki_s2=0.0, kd=0.0, max_rate=1.0)
    with pytest.raises(ConfigError, match=r"LoopCfg\.kd = nan"):
        LoopCfg(kp_s=1.0, ki_s2=0.0, kd=float("nan"), max_rate=1.0)
    with pytest.raises(ConfigError, match=r"speed_s = -1"):
        PidServoCfg(speed_s=-1)
    with pytest.raises(ConfigError, match=r"observation has shape \(3,\)"):
        PidServo().predict(np.zeros(3, np.float32))
    with pytest.raises(ConfigError, match=r"state has shape \(2, 4\): must be \(1, 4\)"):
        PidServo().predict(observation(), np.zeros((2, 4)))
    env = gym.make("SealGym/Flat-v0", control="rmp", perception="oracle")
    with pytest.raises(ConfigError, match="acts with control='tip', the environment has 'rmp'"):
        agents.load_policy("pid_servo", env)


def test_tuning_finds_the_gains_of_a_known_best_servo(capsys):
    """A judge whose RMSE is the distance in gains from a servo on the grid."""
    best = PidServoCfg()
    for name, values in pid_servo.GRID.items():
        best = pid_servo.with_gain(best, name, values[-1])

    def judge(cfg):
        away = (pid_servo.gain_of(cfg, n) - pid_servo.gain_of(best, n) for n in pid_servo.GRID)
        return 0, 1.0 + sum(abs(d) for d in away)

    assert pid_servo.tune(judge) == best
    assert "angle.kd" in capsys.readouterr().out


def test_tuning_puts_failures_first_and_takes_the_stiffest_of_equals(capsys):
    def judge(cfg):
        fails = int(cfg.d_front.kp_s > pid_servo.GRID["distance.kp_s"][0])
        return fails, 1.0 if fails else 1.02

    found = pid_servo.tune(judge)
    assert found.d_front.kp_s == pid_servo.GRID["distance.kp_s"][0]
    assert found.theta_front.kp_s == max(pid_servo.GRID["angle.kp_s"])
    assert "is kept" in capsys.readouterr().out


def test_the_defaults_are_on_the_grid_and_the_cells_frame_is_the_tests():
    for name, values in pid_servo.GRID.items():
        assert pid_servo.gain_of(PidServoCfg(), name) in values
    assert load_cell().timing.frame_s == pytest.approx(FRAME_S)


def test_the_command_scores_the_servo(capsys):
    pid_servo.main(["--trials", "1", "--seconds", "3", "--perception", "oracle"])
    said = capsys.readouterr().out
    assert "2 runs: failed 0, RMSE 0." in said
    with pytest.raises(SystemExit):
        pid_servo.main(["--trials", "0"])
