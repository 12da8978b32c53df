"""Severity 0, order, faces, records: one mechanism for single and vector, rebuilt from its JSON."""

import json
import pickle

import gymnasium as gym
import numpy as np
import pytest

import seal_gym.wrappers as w
from agents.expert import RmpExpert
from seal_gym.core.errors import ConfigError
from seal_gym.envs import vector
from seal_gym.envs.vector import SealVectorEnv
from seal_gym.rmp import Leaf
from seal_gym.wrappers.base import DisturbanceCfg, fork
from seal_gym.wrappers.catalogue import KINDS, disturbance, disturbances, dynamic_regime

IMAGES = {"perception": "vision", "observation": "features+images"}
NEW = not gym.__version__.startswith("0.")


def same(a, b, without=()):
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() - set(without) == b.keys() - set(without)
        for key in a.keys() - set(without):
            same(a[key], b[key], without)
    else:
        np.testing.assert_array_equal(a, b)


def rollout(env, seeds=(5, None), steps=12):
    """Resets and random steps, recorded."""
    rng, out = np.random.default_rng(0), []
    for seed in seeds:
        out.append(env.reset(seed=seed))
        for _ in range(steps):
            action = 0.3 * rng.uniform(-1, 1, env.action_space.shape)
            out.append(env.step(action.astype(np.float32)))
    return out


def equal(one, two, without=()):
    for a, b in zip(one, two, strict=True):
        for x, y in zip(a, b, strict=True):
            same(x, y, without)


@pytest.mark.parametrize("kwargs", [{}, IMAGES], ids=["oracle", "vision"])
def test_severity_0_is_the_bare_environment(make, kwargs):
    off = make(**kwargs, disturbances=[{"name": name, "severity": 0.0} for name in KINDS])
    equal(rollout(make(**kwargs)), rollout(off), without=("disturbances",))


@pytest.mark.parametrize("name", KINDS)
def test_each_changes_something_but_not_the_first_state(make, name):
    """Part, gun, texture, exposure: what the environment draws stays, in later episodes too."""
    bare, env = make(**IMAGES), make(**IMAGES, disturbances=[{"name": name, "severity": 2.0}])
    cores = [e.unwrapped.core for e in (bare, env)]
    changed = False
    for seed in (1, None):
        first = [e.reset(seed=seed)[0] for e in (bare, env)]
        for what in ("q", "part_pose"):
            np.testing.assert_array_equal(*(getattr(c.arm, what) for c in cores))
        np.testing.assert_array_equal(*(c.sensors.look.seed for c in cores))
        np.testing.assert_array_equal(*(c.sensors.look.texture_offset for c in cores))
        rng = np.random.default_rng(2)
        changed |= any((first[0][k] != first[1][k]).any() for k in first[0])
        for _ in range(45):
            action = 0.02 * rng.uniform(-1, 1, 6).astype(np.float32)
            a, b = (e.step(action)[0] for e in (bare, env))
            changed |= any((a[k] != b[k]).any() for k in a)
    if name in ("MovingObstacle", "ExternalPush"):  # comes later, tested elsewhere
        return
    assert changed


def everything(severity=1.0):
    return [{"name": name, "severity": severity} for name in KINDS]


def test_the_order_of_stacking_means_nothing(make):
    ways = [everything(), everything()[::-1], everything()[4:] + everything()[:4]]
    runs = [rollout(make(**IMAGES, disturbances=way)) for way in ways]
    for run in runs[1:]:
        equal(runs[0], run, without=("disturbances",))


def test_wrappers_are_the_keyword_argument(make):
    wrapped = make(**IMAGES)
    for name in list(KINDS)[::-1]:
        wrapped = getattr(w, name)(wrapped, severity=1.0)
    assert isinstance(wrapped, w.DisturbanceWrapper)
    equal(rollout(make(**IMAGES, disturbances=everything())), rollout(wrapped), without=("disturbances",))


def test_rows_of_a_vector_are_the_single_environments(make, make_vec):
    """To the bit, through autoresets, with everything on."""
    kwargs = {**IMAGES, "disturbances": everything(2.0)}
    venv, envs = make_vec(3, **kwargs), [make(**kwargs) for _ in range(3)]
    venv.seed(30)
    batch = venv.reset()
    for i, env in enumerate(envs):
        observation, info = env.reset(seed=30 + i)
        same({k: v[i] for k, v in batch.items()}, observation)
        same(venv.reset_infos[i], info)
    rng, ends = np.random.default_rng(0), 0
    scale = np.array([0.02, 0.6, 0.2])[:, None]
    for _ in range(40):
        action = (scale * rng.uniform(-1, 1, (3, 6))).astype(np.float32)
        batch, reward, done, infos = venv.step(action)
        for i, env in enumerate(envs):
            observation, r, terminated, truncated, info = env.step(action[i])
            assert done[i] == (terminated or truncated) and reward[i] == np.float32(r)
            extra = ("TimeLimit.truncated", "terminal_observation", "episode")
            same(infos[i], info, without=extra)
            if done[i]:
                ends += 1
                observation, _ = env.reset()
            same({k: v[i] for k, v in batch.items()}, observation)
    assert ends >= 2


@pytest.fixture
def native(monkeypatch):
    """Builds the native vector environment, on Gymnasium 0.29 without its refusal."""
    if not NEW:
        monkeypatch.setattr(vector, "require_gymnasium_1", lambda: None)
        monkeypatch.setattr(gym.vector.VectorEnv, "viewer", None, raising=False)
    return lambda n, **kwargs: SealVectorEnv(n, perception="oracle", control="joint", **kwargs)


def test_wrappers_go_round_both_vector_faces(make, make_vec, native):
    env = make(disturbances=["MovingWorkpiece", "MovingObstacle"])
    observation, info = env.reset(seed=8)
    action = np.full((2, 6), 0.01, np.float32)
    after = env.step(action[0])
    sb3 = w.MovingObstacle(w.MovingWorkpiece(make_vec(2)))
    sb3.seed(8)
    np.testing.assert_array_equal(sb3.reset()[0], observation)
    batch, _, _, infos = sb3.step(action)
    np.testing.assert_array_equal(batch[0], after[0])
    same(infos[0], after[-1], without=("TimeLimit.truncated",))
    own = w.MovingObstacle(w.MovingWorkpiece(native(2)))
    batch, infos = own.reset(seed=8)
    np.testing.assert_array_equal(batch[0], observation)
    assert infos["disturbances"][0] == info["disturbances"]
    batch, _, _, _, infos = own.step(action)
    np.testing.assert_array_equal(batch[0], after[0])
    for key in ("position_m", "velocity_m_s", "radius_m"):
        np.testing.assert_array_equal(infos["obstacle"][key][0], after[-1]["obstacle"][key])
    again = pickle.loads(pickle.dumps(own))
    np.testing.assert_array_equal(again.reset(seed=8)[0][0], observation)


def test_a_wrapped_environment_has_to_be_reset(make, make_vec):
    env = make()
    env.reset(seed=0)
    env = w.Lighting(env)
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(np.zeros(6, np.float32))
    venv = make_vec(2)
    venv.reset()
    w.Lighting(venv)
    with pytest.raises(gym.error.ResetNeeded):
        venv.step(np.zeros((2, 6), np.float32))


def test_leaves_and_the_picture_stay_when_a_disturbance_comes(make):
    env = make(control="rmp")
    calls = []

    def leaf(state):
        calls.append(state.obstacle)
        n = len(state.q)
        eye = np.broadcast_to(np.eye(6), (n, 6, 6))
        return Leaf(eye, np.zeros((n, 6)), np.zeros((n, 6)), np.zeros((n, 6, 6)))

    env.unwrapped.add_leaf(leaf)
    env = w.MovingObstacle(env)
    env.reset(seed=0)
    _, _, _, _, info = env.step(np.zeros(27, np.float32))
    assert len(calls) == 1
    assert calls[0].radius == pytest.approx(0.045)
    assert np.linalg.norm(calls[0].position[0] - info["obstacle"]["position_m"]) < 1e-9


# -- records ------------------------------------------------------------------------------------------------


def finish(env, seed):
    policy, done = RmpExpert(), False
    observation, _ = env.reset(seed=seed)
    while not done:
        action, _ = policy.predict(observation)
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    return info["episode_metrics"]


def test_a_run_rebuilt_from_its_json_is_the_same_run(make):
    """From the spec of wrapped and of plain environments, and from an info."""
    short = {"control": "rmp", "env_id": "SealGym/Cylinder-v0"}
    plain = make(**short, disturbances=dynamic_regime(2.0))
    metrics = finish(plain, 77)
    assert metrics["outcome"] == "reached" and metrics["seam_speed_mm_s"] > 1.0
    spec = json.loads(json.dumps(plain.spec.kwargs))
    assert finish(make(plain.spec.id, **spec), 77) == metrics
    _, info = plain.reset(seed=77)
    told = json.loads(json.dumps(info["disturbances"]))
    assert finish(make(**short, disturbances=told), 77) == metrics


def test_gymnasiums_spec_rebuilds_a_wrapped_environment(make):
    env = w.ActuationDelay(w.MovingWorkpiece(make(control="rmp"), severity=2.0, profile="step"), severity=0.5)
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    again = gym.make(spec)
    try:
        assert again.unwrapped.core.cfg.disturbances == env.unwrapped.core.cfg.disturbances
        equal(rollout(env), rollout(again))
    finally:
        again.close()


def test_a_wrapped_environment_can_be_pickled(make):
    env = w.MovingWorkpiece(make().unwrapped, severity=2.0)
    equal(rollout(env), rollout(pickle.loads(pickle.dumps(env))))


@pytest.mark.parametrize("name", KINDS)
def test_configurations_survive_json(name):
    cfg = KINDS[name](severity=0.7)
    written = json.loads(json.dumps(cfg.to_dict()))
    assert disturbance(written) == cfg and written["name"] == name
    assert disturbance(name) == KINDS[name]() and disturbance(cfg) is cfg
    assert getattr(w, name).kind is KINDS[name]
    with pytest.raises(ConfigError, match="version"):
        disturbance({**written, "version": 99})
    with pytest.raises(ConfigError, match="typo"):
        disturbance({"name": name, "typo": 1})
    for severity in (-0.1, 11, "1", None, float("inf")):
        with pytest.raises(ConfigError, match="severity"):
            KINDS[name](severity=severity)


@pytest.mark.parametrize(
    "wrong",
    [["Wind"], [3], [{"severity": 1}], "MovingWorkpiece", {"name": "Lighting"}, 5, None, ["Lighting"] * 2],
)
def test_wrong_lists_are_refused(make, wrong):
    with pytest.raises(ConfigError, match=r"disturbance"):
        make(disturbances=wrong)


def test_only_sealing_environments_can_be_wrapped(make):
    with pytest.raises(ConfigError, match="sealing"):
        w.Lighting(gym.make("CartPole-v1"))
    env = w.Lighting(make())
    with pytest.raises(ConfigError, match="twice"):
        w.Lighting(env)
    with pytest.raises(ConfigError, match="typo"):
        w.Lighting(make(), typo=1)


def test_the_dynamic_regime_is_the_protocols():
    moving, light = disturbances(dynamic_regime(2.0))
    assert (moving.name, light.name) == ("MovingWorkpiece", "Lighting")
    assert moving.severity == light.severity == 2.0 and light.shadow == 0.0
    assert (moving.amplitude_mm, moving.speed_mm_s, moving.yaw_deg, moving.yaw_rate_deg_s) == (20, 10, 10, 3)
    assert (moving.motion, moving.profile) == ("both", "smooth")


def test_forking_takes_nothing_from_the_generator():
    one, two = np.random.default_rng(4), np.random.default_rng(4)
    words = fork(one)
    assert one.random() == two.random()
    assert fork(one) != words and fork(one) == fork(two)


def test_a_base_configuration_has_nothing_to_check():
    assert DisturbanceCfg(severity=2).severity == 2


@pytest.mark.skipif(not NEW, reason="needs gymnasium >= 1.0")
def test_a_vectors_spec_knows_the_disturbances_it_was_wrapped_with():
    venv = gym.make_vec("SealGym/Flat-v0", 2, perception="oracle", disturbances=["ExternalPush"])
    venv = w.MovingWorkpiece(venv, severity=0.5)
    told = json.loads(json.dumps(venv.spec.kwargs["disturbances"]))
    again = gym.make_vec("SealGym/Flat-v0", 2, perception="oracle", disturbances=told)
    assert again.unwrapped.core.cfg.disturbances == venv.unwrapped.core.cfg.disturbances
    assert {d["name"]: d["severity"] for d in told} == {"ExternalPush": 1.0, "MovingWorkpiece": 0.5}
    np.testing.assert_array_equal(venv.reset(seed=1)[0], again.reset(seed=1)[0])
    for env in (venv, again):
        env.close()
