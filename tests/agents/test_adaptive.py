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

CFG = AdaptiveCfg()
LEAN = np.sqrt(0.5)


def blind(cfg=CFG):
    return replace(cfg, depth=replace(cfg.depth, dropout=1.0))


def straight(length=0.01, n=30):
    """A map along the base's y, and a pose that travels along it."""
    track = Track()
    for u in np.linspace(0.0, length, n):
        track = extend(track, np.array([0.1, u, 0.2]), np.eye(4), CFG)._replace(landed=True)
    return track


# -- the map ---------------------------------------------------------------------------------------------


def test_a_polynomial_is_fitted_exactly():
    u = np.linspace(0.3, 0.31, 24)
    coefficients = np.array([[1.0, 2.0, 3.0], [0.6, 0.8, 0.0], [4.0, -3.0, 1.0]])
    points = np.vander(u - 0.3, 3, increasing=True) @ coefficients
    path = fit(points, u, np.array([0.0, 1.0, 0.0]), CFG)
    np.testing.assert_allclose(path.at(u), points, atol=1e-12)
    np.testing.assert_allclose(path.slope(0.3), coefficients[1], atol=1e-8)
    np.testing.assert_allclose(path.bend(0.3), 2 * coefficients[2], atol=1e-5)
    assert path.end == u[-1]
    assert path.spread < 1e-12


def test_a_circle_is_followed_closely():
    radius = 0.07
    u = np.linspace(0.0, 0.008, 24)
    points = radius * np.column_stack((np.cos(u / radius), np.sin(u / radius), 0 * u))
    path = fit(points, u, np.array([0.0, 1.0, 0.0]), CFG)
    np.testing.assert_allclose(np.linalg.norm(path.at(u), axis=1), radius, atol=1e-6)
    assert np.linalg.norm(path.bend(0.004)) == pytest.approx(1 / radius, rel=1e-2)


def test_few_points_go_straight_ahead():
    points = np.array([[0.0, 0.0, 0.0], [2e-5, 3e-4, 0.0], [-2e-5, 6e-4, 0.0]])
    path = fit(points, np.array([0.0, 3e-4, 6e-4]), np.array([0.0, 1.0, 0.0]), CFG)
    np.testing.assert_allclose(path.slope(0.0), [0.0, 1.0, 0.0])
    np.testing.assert_allclose(path.at(path.origin), [0.0, 3e-4, 0.0])


def test_outliers_are_refused_until_they_persist():
    track = straight()
    far = np.array([0.105, 0.0103, 0.2])
    for k in range(1, CFG.patience + 1):
        track = extend(track, far, np.eye(4), CFG)
        assert track.outliers == k
        np.testing.assert_allclose(track.path.at(0.005)[[0, 2]], [0.1, 0.2], atol=1e-9)
    begun = extend(track, far, np.eye(4), CFG)
    np.testing.assert_array_equal(begun.points, far[None])
    assert begun.landed


def test_one_good_point_forgives_outliers():
    track = extend(straight(), np.array([0.105, 0.0103, 0.2]), np.eye(4), CFG)
    track = extend(track, np.array([0.1, 0.0104, 0.2]), np.eye(4), CFG)
    assert track.outliers == 0
    assert len(track.points) == CFG.window


def test_points_are_kept_a_spacing_apart_and_only_the_last_ones():
    track = straight()
    assert len(track.points) == CFG.window
    again = extend(track, track.points[-1] + [0.0, 1e-4, 0.0], np.eye(4), CFG)
    np.testing.assert_array_equal(again.points, track.points)
    more = extend(track, track.points[-1] + [0.0, 3e-4, 0.0], np.eye(4), CFG)
    np.testing.assert_array_equal(more.points[:-1], track.points[1:])
    assert more.arc[-1] == pytest.approx(track.arc[-1] + 3e-4)


def test_the_path_is_replanned_every_few_points():
    cfg = replace(CFG, replan=3)
    track = straight()
    ends = []
    for k in range(1, 7):
        track = extend(track, np.array([0.1, 0.01 + 3e-4 * k, 0.2]), np.eye(4), cfg)
        ends.append(track.path.end)
    np.testing.assert_allclose(ends, 0.01 + 3e-4 * np.array([0, 0, 3, 3, 3, 6]), atol=1e-12)


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


def make(workpiece="flat"):
    return gym.make("SealGym/Seal-v0", workpiece=workpiece, control="tip", perception="oracle")


@pytest.mark.parametrize("workpiece", ["flat", "cylinder", "rectangular"])
def test_it_seals_parts_that_stand_still(workpiece):
    env = make(workpiece)
    _, info, _, _ = run(Adaptive.of(env), env, 500_100, 5000)
    metrics = info["episode_metrics"]
    assert metrics["outcome"] == "reached"
    assert metrics["rmse_mm"] < 0.15
    assert metrics["coverage_pct"] > 90.0


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
    left = CFG.depth.look_ahead_m + CFG.extrapolate_m
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

    def episodes(part, trials, seed, cfg):
        ran.append((part, cfg.window, cfg.order))
        reached = cfg.window == 40
        rmse = 0.1 if cfg.order == 2 else 0.05
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
    rows = list(tune_adaptive.tune(2, 500_000, log))
    assert rows[-1]["settings"]["window"] == 40
    assert rows[-1]["settings"]["order"] == 1  # the first of two that are equal
    assert rows[-1]["parts"]["flat"] == {
        "trials": 2, "reached": 2, "collision": 0, "timeout": 0, "rmse_mm": 0.05, "time_s": 30.0
    }  # fmt: skip
    count = len(ran)
    assert list(tune_adaptive.tune(2, 500_000, log)) == rows
    assert len(ran) == count
    assert "| 2/2, 0.050 |" in tune_adaptive.table(rows)


def test_tuning_stays_on_validation_seeds(tmp_path):
    with pytest.raises(SystemExit, match="500000"):
        tune_adaptive.main(["--seed", "1000000", "--out", str(tmp_path)])
