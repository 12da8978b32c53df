"""Episodes that start at the arm's home: all faces, what counts on the way, the ways there and back."""

import gymnasium as gym
import numpy as np
import pytest

import agents
from agents.travel import Follower, play_from_home
from seal_gym.core.errors import ConfigError
from seal_gym.core.kinematics import HOME_Q, tip_kinematics
from seal_gym.envs.sb3 import SealSb3VecEnv
from seal_gym.envs.seal_env import SealEnv
from seal_gym.envs.vector import SealVectorEnv
from seal_gym.planning.approach import ApproachCfg, plan_departure, plan_journey

HOME = {"start": "home"}
NEW = int(gym.__version__.split(".")[0]) >= 1


@pytest.fixture
def make():
    made = []

    def build(**kwargs):
        made.append(SealEnv(**{"perception": "oracle", **kwargs}))
        return made[-1]

    yield build
    for env in made:
        env.close()


@pytest.mark.parametrize("workpiece", ["flat", "cylinder", "rectangular"])
def test_home_and_hover_differ_in_the_arm_alone(make, workpiece):
    env = make(workpiece=workpiece)
    env.reset(seed=5)
    part, hover = env.core.arm.part_pose.copy(), env.core.tip.pose[0].copy()
    observation, info = env.reset(seed=5, options=HOME)
    np.testing.assert_array_equal(env.core.arm.part_pose, part)
    np.testing.assert_allclose(info["hover_pose"], hover, atol=1e-9)
    np.testing.assert_array_equal(env.core.arm.q[0], HOME_Q)
    assert not env.core.arm.contacts(0)
    np.testing.assert_allclose(observation[23:29], HOME_Q, rtol=1e-6)
    assert info["under_way"] and observation[2] == observation[5] == 0.0
    env.reset(seed=5)
    assert "hover_pose" not in env.reset(seed=5)[1]


@pytest.mark.parametrize("perception", ["oracle", "vision"])
@pytest.mark.parametrize("method", ["rmp_expert", "neural_control"])
def test_from_home_to_home_nothing_is_touched(make, perception, method):
    env = make(workpiece="flat", perception=perception, control=agents.control_of(method))
    states = []
    metrics = play_from_home(
        agents.load_policy(method, env),
        env,
        11,
        lambda e, info: states.append((e.core.journey.under_way[0], info)),
    )
    assert metrics["reached"] and not metrics["home_touched"] and metrics["rmse_mm"] < 0.1
    under_way = [bool(u) for u, _ in states]
    journey = under_way.index(False)
    assert not any(under_way[journey:])
    assert metrics["journey_s"] == pytest.approx(journey / 30.0)
    assert all(
        info["progress"] == 0.0 and info["roi"]["valid_front"] is False for _, info in states[1:journey]
    )
    # What the episode's errors are made of begins where the gun arrives.
    errors = [info["tip_error_mm"] for _, info in states]
    ended = next(k for k, (_, info) in enumerate(states) if "episode_metrics" in info)
    assert metrics["rmse_whole_mm"] == pytest.approx(
        np.sqrt(np.mean(np.square(errors[journey : ended + 1]))), rel=1e-9
    )
    np.testing.assert_allclose(env.core.arm.q[0], HOME_Q, atol=0.01)


def test_joint_control_keeps_to_the_plan(make):
    env = make(workpiece="rectangular", control="joint")
    observation, info = env.reset(seed=3, options=HOME)
    way = plan_journey(HOME_Q, info["hover_pose"])
    follower, off = Follower(way, "joint"), []
    while not follower.over:
        observation, _, terminated, *_ = env.step(follower.act(observation))
        assert not terminated
        off.append(np.abs(env.core.arm.q[0] - way.q[follower.frame]).max())
    assert max(off) < 0.01
    assert not env.core.journey.under_way[0]


def test_a_gun_that_never_leaves_home_times_out_and_is_not_lost(make):
    env = make(workpiece="flat")
    _, info = env.reset(seed=0, options=HOME)
    limit = env.core.time_limit + 300
    for k in range(limit):
        _, _, terminated, truncated, info = env.step(np.zeros(6, np.float32))
        assert not terminated and truncated == (k == limit - 1)
    assert info["episode_metrics"]["timeout"] and info["episode_metrics"]["outcome"] == "timeout"
    assert info["episode_metrics"]["rmse_mm"] is None


def test_the_valve_is_locked_on_the_way(make):
    env = make(workpiece="flat", sealant=True)
    env.reset(seed=0, options=HOME)
    for _ in range(30):
        env.step(np.array([0, 0, 0, 0, 0, 0, 1.0], np.float32))
    bead = env.core.extrusion.bead
    assert bead.used[0] == 0.0
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.array([0, 0, 0, 0, 0, 0, 1.0], np.float32))
    assert bead.used[0] > 0.0


@pytest.mark.skipif(not NEW, reason="needs gymnasium >= 1.0")
def test_vector_environments_start_at_home_too(make):
    single = make(workpiece="flat")
    expected, info = single.reset(seed=8, options=HOME)
    venv = SealVectorEnv(2, workpiece="flat", perception="oracle")
    many, infos = venv.reset(seed=[8, 9], options=HOME)
    np.testing.assert_array_equal(many[0], expected)
    np.testing.assert_array_equal(infos["hover_pose"][0], info["hover_pose"])
    assert infos["under_way"].tolist() == [True, True]
    _, infos = venv.reset(seed=[8, 9], options={"reset_mask": np.array([False, True])})
    assert "hover_pose" not in infos
    *_, infos = venv.step(np.zeros((2, 6), np.float32))
    assert infos["_under_way"].tolist() == [True, False]
    venv.close()


def test_sb3s_environments_start_at_home_once(make):
    expected, _ = make(workpiece="flat").reset(seed=8, options=HOME)
    sb3 = SealSb3VecEnv(2, workpiece="flat", perception="oracle")
    sb3.seed(8)
    sb3.set_options([HOME, {}])
    np.testing.assert_array_equal(sb3.reset()[0], expected)
    assert sb3.core.journey.from_home.tolist() == [True, False]
    sb3.reset()
    assert not sb3.core.journey.from_home.any()
    sb3.close()


@pytest.mark.parametrize("options", [{"start": "nowhere"}, {"begin": "home"}, {"start": None}])
def test_other_options_are_refused(make, options):
    with pytest.raises(ConfigError, match="start"):
        make(workpiece="flat").reset(options=options)


def test_a_part_in_the_way_of_home_is_named(make, monkeypatch):
    env = make(workpiece="flat")
    monkeypatch.setattr("seal_gym.envs.core.HOME_Q", np.radians([-4.0, -130.0, -95.0, -102.0, 87.0, -93.0]))
    with pytest.raises(ConfigError, match="posture of rest"):
        env.reset(seed=0, options=HOME)


def test_ways_stop_over_above_the_seam_and_keep_the_tip_below_its_limit():
    q = np.radians([-15.0, -117.0, -98.0, -90.0, 120.0, -54.0])
    hover = tip_kinematics(q[None], np.zeros((1, 6))).pose[0]
    cfg = ApproachCfg(tip_m_s2=0.5, room_m=0.04)
    for way, ends in (
        (plan_journey(HOME_Q, hover, cfg=cfg), (HOME_Q, q)),
        (plan_departure(q, HOME_Q, cfg=cfg), (q, HOME_Q)),
    ):
        np.testing.assert_allclose(way.q[[0, -1]], ends, atol=1e-9)
        assert np.abs(way.qd[[0, -1]]).max() < 1e-9
        tips = tip_kinematics(way.q, way.qd).pose[:, :3, 3]
        above = hover[:3, 3] + 0.04 * hover[:3, 2]
        assert np.linalg.norm(tips - above, axis=1).min() < 1e-6
        # Second differences of positions: an independent measure of acceleration.
        accel = np.linalg.norm(np.diff(tips, 2, axis=0), axis=1) * 30.0**2
        assert accel.max() < 1.02 * 0.5
        assert accel.max() > 0.4
        rates = np.diff(way.q, axis=0) * 30.0
        np.testing.assert_allclose(rates, 0.5 * (way.qd[1:] + way.qd[:-1]), atol=0.02)
