from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import seal_gym  # noqa: F401  # registers the ids
from agents import tune_adaptive
from agents.adaptive import (
    Adaptive,
    AdaptiveCfg,
    Aim,
    Path,
    Track,
    abreast,
    aim,
    extend,
    fit,
    servo,
    speed_left,
)
from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import transform, yaw_pose
from seal_gym.envs.sb3 import SealSb3VecEnv
from seal_gym.tasks.progress import SealTaskCfg

CFG = AdaptiveCfg(window=24, order=2, motion=2)
PLAIN = AdaptiveCfg.plain(window=24, order=2)
FORWARD, SPEED = np.array([0.0, 1.0, 0.0]), 0.01
LEAN = np.sqrt(0.5)


def blind(cfg=CFG):
    return replace(cfg, depth=replace(cfg.depth, dropout=1.0))


def straight(length=0.01, n=30):
    """The plain variant's map along the base's y, and a pose that travels along it."""
    track = Track()
    for u in np.linspace(0.0, length, n):
        track = join(track, np.array([0.1, u, 0.2]))._replace(landed=True)
    return track


def join(track, point, cfg=PLAIN):
    return extend(track, [point], 0.0, np.eye(4), cfg)


def fit_at_rest(points, arc, cfg=PLAIN):
    last = Path(np.array([points[0], FORWARD]), 0.0, 0.0, 0.0)
    return fit(points, arc, np.zeros(len(arc)), FORWARD, cfg, last)


def follow(cfg, seam, frames=60, rng=None):
    """The map of a gun that travels along the base's y over a seam: ``seam(y, t)`` is its place at y."""
    track, sigma = Track(), 0.0 if rng is None else 2e-5
    for k in range(frames):
        t = k / 30
        tip = transform(np.eye(3), np.array([0.0, SPEED * t, 0.0]))
        lines = [cfg.depth.look_ahead_m, cfg.depth.look_ahead_m + cfg.second_line_m]
        points = [seam(tip[1, 3] + y, t) for y in lines[: 1 + (cfg.second_line_m > 0)]]
        if rng is not None:
            points = [p + sigma * rng.standard_normal(3) * [1, 0, 1] for p in points]
        track = extend(track, points, t, tip, cfg)._replace(landed=True)
    return track, tip, t


# -- the map ---------------------------------------------------------------------------------------------


def test_a_polynomial_is_fitted_exactly():
    u = np.linspace(0.3, 0.31, 24)
    coefficients = np.array([[1.0, 2.0, 3.0], [0.6, 0.8, 0.0], [4.0, -3.0, 1.0]])
    points = np.vander(u - 0.3, 3, increasing=True) @ coefficients
    path = fit_at_rest(points, u)
    np.testing.assert_allclose(path.at(u), points, atol=1e-12)
    np.testing.assert_allclose(path.slope(0.3), coefficients[1], atol=1e-8)
    np.testing.assert_allclose(path.bend(0.3), 2 * coefficients[2], atol=1e-5)
    assert path.end == u[-1]
    assert path.spread < 1e-12


def test_a_circle_is_followed_closely():
    radius = 0.07
    u = np.linspace(0.0, 0.008, 24)
    points = radius * np.column_stack((np.cos(u / radius), np.sin(u / radius), 0 * u))
    path = fit_at_rest(points, u)
    np.testing.assert_allclose(np.linalg.norm(path.at(u), axis=1), radius, atol=1e-6)
    assert np.linalg.norm(path.bend(0.004)) == pytest.approx(1 / radius, rel=1e-2)


def test_few_points_go_straight_ahead():
    points = np.array([[0.0, 0.0, 0.0], [2e-5, 3e-4, 0.0], [-2e-5, 6e-4, 0.0]])
    path = fit_at_rest(points, np.array([0.0, 3e-4, 6e-4]))
    np.testing.assert_allclose(path.slope(0.0), [0.0, 1.0, 0.0])
    np.testing.assert_allclose(path.at(path.origin), [0.0, 3e-4, 0.0], atol=1e-15)


def test_outliers_are_refused_until_they_persist():
    track = straight()
    far = np.array([0.105, 0.0103, 0.2])
    for k in range(1, CFG.patience + 1):
        track = join(track, far)
        assert track.outliers == k
        np.testing.assert_allclose(track.path.at(0.005)[[0, 2]], [0.1, 0.2], atol=1e-9)
    begun = join(track, far)
    np.testing.assert_array_equal(begun.points, far[None])
    assert begun.landed


def test_one_good_point_forgives_outliers():
    track = join(straight(), np.array([0.105, 0.0103, 0.2]))
    track = join(track, np.array([0.1, 0.0104, 0.2]))
    assert track.outliers == 0
    assert len(track.points) == CFG.window


def test_points_are_kept_a_spacing_apart_and_only_the_last_ones():
    track = straight()
    assert len(track.points) == CFG.window
    again = join(track, track.points[-1] + [0.0, 1e-4, 0.0])
    np.testing.assert_array_equal(again.points, track.points)
    more = join(track, track.points[-1] + [0.0, 3e-4, 0.0])
    np.testing.assert_array_equal(more.points[:-1], track.points[1:])
    assert more.arc[-1] == pytest.approx(track.arc[-1] + 3e-4)


def test_the_path_is_replanned_every_few_points():
    cfg = replace(PLAIN, replan=3)
    track = straight()
    ends = []
    for k in range(1, 7):
        track = join(track, np.array([0.1, 0.01 + 3e-4 * k, 0.2]), cfg)
        ends.append(track.path.end)
    np.testing.assert_allclose(ends, 0.01 + 3e-4 * np.array([0, 0, 3, 3, 3, 6]), atol=1e-12)


# -- the part's motion -----------------------------------------------------------------------------------


def test_two_lines_tell_motion_from_slant():
    velocity, slant = np.array([0.006, 0.0, -0.002]), 0.2
    moving, tip, t = follow(CFG, lambda y, t: velocity * t + y * FORWARD)
    path = moving.path
    np.testing.assert_allclose(path.drift[0], velocity, atol=2e-6)
    np.testing.assert_allclose(path.drift[1], 0.0, atol=2e-5)
    # Abreast of the tip the seam was seen 0.3 s ago; the path holds for now.
    here = path.at(abreast(path, tip, moving.at + tip[1, 3]))
    np.testing.assert_allclose(here, velocity * t + tip[1, 3] * FORWARD, atol=2e-6)
    np.testing.assert_allclose(
        path.slope(path.end) / np.linalg.norm(path.slope(path.end)), FORWARD, atol=1e-3
    )
    resting, _, _ = follow(CFG, lambda y, t: np.array([slant * y, y, 0.0]))
    np.testing.assert_allclose(resting.path.drift, 0.0, atol=1e-9)
    slope = resting.path.slope(resting.path.end)
    assert slope[0] / slope[1] == pytest.approx(slant)


def test_a_part_that_speeds_up_is_followed():
    accel = 0.004
    track, tip, t = follow(CFG, lambda y, t: np.array([0.5 * accel * t * t, y, 0.0]))
    assert track.path.drift[0, 0] == pytest.approx(accel * t, rel=0.02)
    here = track.path.at(abreast(track.path, tip, tip[1, 3]))
    assert here[0] == pytest.approx(0.5 * accel * t * t, abs=2e-5)
    steady = replace(CFG, motion=1)
    late, _, _ = follow(steady, lambda y, t: np.array([0.5 * accel * t * t, y, 0.0]))
    assert late.path.drift[0, 0] < accel * (t - 0.1)  # the window's mean is late


def test_noise_of_the_points_becomes_little_noise_of_the_motion():
    rng, found = np.random.default_rng(5), []
    for _ in range(10):
        track, _, _ = follow(CFG, lambda y, t: np.array([0.005 * t, y, 0.0]), 45, rng)
        found.append(track.path.drift[0, 0])
    assert np.mean(found) == pytest.approx(0.005, abs=3e-4)
    assert np.std(found) < 6e-4


def test_one_line_is_late_by_what_the_part_moves_in_the_look_ahead():
    velocity = 0.004
    track, tip, t = follow(PLAIN, lambda y, t: np.array([velocity * t, y, 0.0]))
    here = track.path.at(abreast(track.path, tip, track.path.end))
    late = PLAIN.depth.look_ahead_m / SPEED
    assert velocity * t - here[0] == pytest.approx(velocity * late, rel=1e-3)
    # A resting seam of this slant gives the same points: no filter could tell.
    slanted, _, _ = follow(PLAIN, lambda y, t: np.array([velocity / SPEED * (y - 0.003), y, 0.0]))
    np.testing.assert_allclose(slanted.points, track.points, atol=1e-12)
    with pytest.raises(ConfigError, match=r"second_line_m > 0, or motion=0"):
        replace(PLAIN, motion=1)


def test_a_path_moves_as_its_drift_says():
    path = Path(
        np.array([[0.1, 0.2, 0.3], FORWARD]), 0.0, 0.0, 0.0, np.array([[1.0, 0, 0], [0, 0, 4.0]]), 2.0
    )
    later = path.moved(2.5)
    np.testing.assert_allclose(later.coefficients, [[0.6, 0.2, 0.8], FORWARD])  # v t, a t^2 / 2
    np.testing.assert_allclose(later.drift, [[1.0, 0.0, 2.0], [0.0, 0.0, 4.0]])
    np.testing.assert_allclose(later.moved(2.0).coefficients, path.coefficients, atol=1e-15)


def test_the_servo_is_fed_the_seams_motion_but_not_along_the_seam():
    drift = np.array([[0.003, 0.007, -0.002]])
    path = Path(np.array([[0, 0, -3e-3], FORWARD]), 0.0, 0.01, 0.0, drift)
    target = aim(path, 0.0, np.eye(4), SPEED, 0.003, 0.0)
    np.testing.assert_allclose(target.reference, [0.003, SPEED, -0.002, 0, 0, 0], atol=1e-15)


# -- the servo -------------------------------------------------------------------------------------------


def test_abreast_of_a_line():
    path = Path(np.array([[0.1, 0.0, 0.0], [0.6, 0.8, 0.0]]), 0.0, 0.1, 0.0)
    # The tip's y is the base's y: the line crosses y = 0.04 after 0.04 / 0.8.
    assert abreast(path, transform(np.eye(3), np.array([0.3, 0.04, 0.5])), 0.0) == pytest.approx(0.05)


def test_the_gun_can_stop_where_the_path_ends():
    left, travelled, dt = 0.004, 0.0, 1e-4
    for _ in range(20000):
        speed = speed_left(left - travelled, 0.01, 0.1)
        travelled += speed * dt
    assert speed_left(0.004, 0.01, 0.1) == 0.01
    assert speed < 1e-4
    assert travelled == pytest.approx(left, abs=1e-5)
    assert speed_left(-0.001, 0.01, 0.1) == 0.0


def test_small_errors_die_out_as_in_the_closed_form():
    dt, x, v = 1e-5, -1e-3, 0.0
    damped = CFG.omega_n * np.sqrt(1 - CFG.zeta**2)
    for step in range(1, 30001):
        a = servo(Aim(np.array([-x, 0, 0, 0, 0, 0]), np.zeros(6)), np.array([v, 0, 0, 0, 0, 0]), CFG)[0]
        v += a * dt
        x += v * dt
        if step % 6000 == 0:
            t = step * dt
            decay = np.exp(-CFG.zeta * CFG.omega_n * t)
            sway = np.cos(damped * t) + CFG.zeta * CFG.omega_n / damped * np.sin(damped * t)
            assert x == pytest.approx(-1e-3 * decay * sway, abs=2e-7)


def test_large_errors_are_approached_at_a_bounded_speed_in_a_straight_line():
    dt, x, v = 1e-3, np.array([0.03, 0.0, -0.04]), np.zeros(3)
    for _ in range(600):
        a = servo(Aim(np.concatenate((-x, np.zeros(3))), np.zeros(6)), np.concatenate((v, np.zeros(3))), CFG)
        v = v + a[:3] * dt
        x = x + v * dt
    assert np.linalg.norm(v) == pytest.approx(CFG.approach_m_s, rel=1e-2)
    assert abs(x[0] * -0.04 - x[2] * 0.03) < 1e-12


def test_reference_in_a_bend_is_the_rigid_turn_about_its_axis():
    # The foot of a cylinder on the left, the nozzle leaning 45 deg to the right, 3 mm off the seam.
    radius, stand_off, speed = 0.07, 0.003, 0.01
    approach = np.array([LEAN, 0.0, LEAN])
    rotation = np.column_stack((np.cross([0, 1, 0], approach), [0, 1, 0], approach))
    seam = np.array([radius, 0.0, 0.0])
    pose = transform(rotation, seam + stand_off * approach)
    path = Path(np.array([seam, [0, 1, 0], [-0.5 / radius, 0, 0]]), 0.0, 0.01, 0.0)
    target = aim(path, 0.0, pose, speed, stand_off, 0.0)
    np.testing.assert_allclose(target.error, 0.0, atol=1e-12)
    rate = speed / (radius + stand_off * LEAN)  # about the cylinder's axis
    expected = np.concatenate((rotation.T @ [0, speed, 0], rotation.T @ [0, 0, rate]))
    np.testing.assert_allclose(target.reference, expected, atol=1e-12)


def test_errors_in_the_tip_frame():
    path = Path(np.array([[1e-3, 0, -5e-3], [np.sin(0.1), np.cos(0.1), 0]]), 0.0, 0.01, 0.0)
    target = aim(path, 0.0, np.eye(4), 0.01, 0.003, 0.02)
    np.testing.assert_allclose(target.error, [1e-3, 0, -2e-3, 0, 0.02, -0.1], atol=1e-12)


# -- the policy ------------------------------------------------------------------------------------------


def run(policy, env, seed, frames, state=None):
    """Drives a single environment; gives actions, the last info and the state."""
    observation, info = env.reset(seed=seed)
    actions, start = [], np.array([True])
    for _ in range(frames):
        action, state = policy.predict(observation, state, start)
        observation, _, ended, late, info = env.step(action)
        actions.append(action)
        start = np.array([False])
        if ended or late:
            break
    return np.array(actions), info, state, observation


def make(workpiece="flat", **kwargs):
    return gym.make("SealGym/Seal-v0", workpiece=workpiece, control="tip", perception="oracle", **kwargs)


@pytest.mark.parametrize("workpiece", ["flat", "cylinder", "rectangular"])
def test_it_seals_parts_that_stand_still(workpiece):
    env = make(workpiece)
    _, info, _, _ = run(Adaptive.of(env), env, 500_100, 5000)
    metrics = info["episode_metrics"]
    assert metrics["outcome"] == "reached"
    assert metrics["rmse_mm"] < 0.15
    assert metrics["coverage_pct"] > 90.0


@pytest.mark.parametrize("workpiece", ["flat", "cylinder"])
def test_it_seals_parts_that_move_and_the_published_method_does_not(workpiece):
    env = make(workpiece, disturbances=["MovingWorkpiece"])
    _, info, _, _ = run(Adaptive.of(env), env, 500_001, 5000)
    assert info["episode_metrics"]["outcome"] == "reached"
    assert info["episode_metrics"]["rmse_mm"] < 0.15
    _, info, _, _ = run(Adaptive.of(env, PLAIN), env, 500_001, 5000)
    assert not info["is_success"]


def test_faces_and_repetitions_agree_to_the_bit():
    env = make("cylinder")
    policy = Adaptive.of(env)
    alone = [run(policy, env, seed, 60)[0] for seed in (500_201, 500_202, 500_202)]
    np.testing.assert_array_equal(alone[1], alone[2])
    assert not np.array_equal(alone[0], alone[1])
    venv = SealSb3VecEnv(2, workpiece="cylinder", control="tip", perception="oracle")
    together = Adaptive.of(venv)
    venv.seed(500_201)
    observation, state = venv.reset(), None
    for k in range(60):
        action, state = together.predict(observation, state, np.full(2, k == 0))
        np.testing.assert_array_equal(action, [alone[0][k], alone[1][k]])
        observation, *_ = venv.step(action)
    venv.close()


def test_a_new_episode_begins_with_an_empty_memory():
    env = make()
    policy = Adaptive.of(env)
    first, _, state, _ = run(policy, env, 500_300, 50)
    assert state[0].landed
    again, _, _, _ = run(policy, env, 500_300, 50, state)
    np.testing.assert_array_equal(first, again)


def test_without_a_measurement_it_waits():
    env = make()
    _, info, state, _ = run(Adaptive.of(env, blind()), env, 500_400, 60)
    assert state[0].path is None
    assert info["progress"] == 0.0
    assert np.abs(env.unwrapped.core.tip.twist).max() < 1e-3


def test_gone_blind_it_stops_at_the_end_of_its_path():
    env = make()
    policy = Adaptive.of(env)
    _, info, state, observation = run(policy, env, 500_500, 150)
    before = info["progress"] * 0.3
    policy = Adaptive.of(env, blind())
    for _ in range(60):
        action, state = policy.predict(observation, state, np.array([False]))
        observation, _, _, _, info = env.step(action)
    left = CFG.depth.look_ahead_m + CFG.second_line_m + CFG.extrapolate_m
    assert info["progress"] * 0.3 - before == pytest.approx(left, abs=8e-4)
    assert np.abs(env.unwrapped.core.tip.twist[0, :3]).max() < 5e-4
    assert not info["collision"]


def test_it_knows_of_the_part_by_its_sensor_only():
    env = make()
    _, _, state, observation = run(Adaptive.of(env), env, 500_600, 120)
    core = env.unwrapped.core

    def act(cfg):
        return Adaptive.of(env, cfg).predict(observation, state, np.array([False]))[0]

    seeing, unseeing = act(CFG), act(blind())
    core.arm.place_part(0, core.arm.part_pose[0] @ yaw_pose(0.0, 3e-4, 0.0, 0.0))
    np.testing.assert_array_equal(act(blind()), unseeing)
    assert not np.array_equal(act(CFG), seeing)


def test_it_wants_its_environment():
    with pytest.raises(ConfigError, match=r"load_policy\('adaptive', env\)"):
        Adaptive.of(None)
    with pytest.raises(ConfigError, match=r"observation of 3 simulations.*has 1"):
        Adaptive.of(make()).predict(np.zeros((3, 35), np.float32))


@pytest.mark.parametrize("change", [{"window": 3}, {"order": 4}, {"omega_n": 0.0}, {"extrapolate_m": -1e-3}])
def test_nonsense_is_refused(change):
    with pytest.raises(ConfigError, match=next(iter(change))):
        AdaptiveCfg(**change)


# -- tuning ----------------------------------------------------------------------------------------------


def test_tuning_takes_the_setting_that_reaches_most_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    ran = []

    def episodes(part, trials, seed, cfg, severity):
        assert severity == 0.5
        ran.append((part, cfg.window, cfg.order))
        reached = cfg.window == 40
        rmse = 0.1 if cfg.order == 3 else 0.05
        row = {
            "reached": reached,
            "collision": not reached,
            "timeout": False,
            "rmse_mm": rmse,
            "time_s": 30.0,
        }
        return [row] * trials

    monkeypatch.setattr(tune_adaptive, "episodes", episodes)
    log = tmp_path / "log.jsonl"
    what = tune_adaptive.TuneCfg(trials=2, severity=0.5)
    rows = list(tune_adaptive.tune(what, log))
    assert rows[-1]["settings"]["window"] == 40
    assert rows[-1]["settings"]["order"] == 1  # the first of two that are equal
    assert rows[-1]["parts"]["flat"] == {
        "trials": 2, "reached": 2, "collision": 0, "timeout": 0, "rmse_mm": 0.05, "time_s": 30.0
    }  # fmt: skip
    count = len(ran)
    assert list(tune_adaptive.tune(what, log)) == rows
    assert len(ran) == count
    assert "| 2/2, 0.050 |" in tune_adaptive.table(rows)
    # Other conditions are other rows.
    monkeypatch.setattr(tune_adaptive, "episodes", lambda *args: [RESULT] * 2)
    plain = list(tune_adaptive.tune(tune_adaptive.TuneCfg(trials=2, plain=True), log))
    assert plain[-1]["parts"]["flat"]["rmse_mm"] == RESULT["rmse_mm"]
    assert "motion" not in plain[-1]["settings"]
    assert tune_adaptive.configure(plain[-1]["settings"], AdaptiveCfg.plain()) == AdaptiveCfg.plain()


RESULT = {"reached": True, "collision": False, "timeout": False, "rmse_mm": 0.7, "time_s": 30.0}


def test_the_command_hands_the_severity_to_the_parts(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(tune_adaptive, "episodes", lambda *args: seen.append(args[-1]) or [RESULT])
    tune_adaptive.main(["--trials", "1", "--severity", "0.5", "--out", str(tmp_path)])
    assert set(seen) == {0.5}
    with pytest.raises(SystemExit, match="severity"):
        tune_adaptive.main(["--severity", "-1", "--out", str(tmp_path)])


def test_severity_moves_the_part(monkeypatch):
    made = []

    class Spy(SealSb3VecEnv):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **{**kwargs, "task": SealTaskCfg(time_factor=0.01)})
            made.append((self.core, []))

        def step_wait(self):
            made[-1][1].append(self.core.arm.part_pose.copy())
            return super().step_wait()

    monkeypatch.setattr(tune_adaptive, "SealSb3VecEnv", Spy)
    for severity in (0.0, 1.0):
        tune_adaptive.episodes("flat", 1, 500_000, severity=severity)
    still, moving = (np.ptp(np.stack(poses), axis=0).max() for _, poses in made)
    assert still == 0.0
    assert moving > 1e-5


def test_tuning_stays_on_validation_seeds(tmp_path):
    with pytest.raises(SystemExit, match="500000"):
        tune_adaptive.main(["--seed", "1000000", "--out", str(tmp_path)])
