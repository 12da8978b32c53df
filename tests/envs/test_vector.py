"""``SealVectorEnv``: the single environments' numbers, to the bit, with Gymnasium's conventions."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector.utils import batch_space

import seal_gym
from seal_gym.core.errors import ActionError, ConfigError, SealGymError
from seal_gym.envs import vector
from seal_gym.envs.seal_env import SealEnv
from seal_gym.envs.vector import SealVectorEnv, require_gymnasium_1
from seal_gym.tasks.progress import SealTaskCfg

IDS = seal_gym.ENV_IDS
NEW = not gym.__version__.startswith("0.")
SHORT = SealTaskCfg(time_factor=0.009)  # ends by timeout after 6-11 frames; harder actions end sooner


@pytest.fixture
def make_vec(monkeypatch):
    """Builds vector environments; on 0.29, where users are refused, without the refusal.

    Nothing of Gymnasium's base class is used, so the numbers are the same on both.
    """
    if not NEW:
        monkeypatch.setattr(vector, "require_gymnasium_1", lambda: None)
        monkeypatch.setattr(gym.vector.VectorEnv, "viewer", None, raising=False)
    made = []

    def build(env_id="SealGym/Flat-v0", num_envs=3, **kwargs):
        made.append(SealVectorEnv(num_envs, **{**gym.spec(env_id).kwargs, **kwargs}))
        return made[-1]

    yield build
    for env in made:
        env.close()


def same(a, b):
    if isinstance(b, dict):
        assert a.keys() == b.keys()
        for key in b:
            same(a[key], b[key])
    elif b is None:
        assert a is None or np.isnan(a)  # an array of floats holds None as NaN
    else:
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_array_equal(a, b)


def row(x, i):
    """Row i of a batched observation or info, without the rows' masks."""
    if isinstance(x, dict):
        return {
            k: row(v, i)
            for k, v in x.items()
            if not k.startswith("_") and (f"_{k}" not in x or x[f"_{k}"][i]) and k != "final_info"
        }
    return x[i]


def singles(env_id, n, **kwargs):
    return [SealEnv(**{**gym.spec(env_id).kwargs, **kwargs}) for _ in range(n)]


@pytest.mark.parametrize("observation", ["features", "features+images"])
@pytest.mark.parametrize("control", ["tip", "rmp", "joint"])
@pytest.mark.parametrize("env_id", IDS)
def test_rows_are_the_single_environments_to_the_bit(make_vec, env_id, control, observation):
    """Through ends and next-step autoresets, with a seed a row and generators that go on."""
    n, steps = 3, 25 if observation == "features" else 14
    kwargs = {"control": control, "observation": observation, "task": SHORT}
    venv, envs = make_vec(env_id, n, **kwargs), singles(env_id, n, **kwargs)
    size = venv.single_action_space.shape[0]
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, n, size)).astype(np.float32)
    actions *= np.array([0.05, 1.0, 0.3], np.float32)[:, None]  # rows end at different times
    batch, infos = venv.reset(seed=40)
    starts = [env.reset(seed=40 + i) for i, env in enumerate(envs)]
    for i, (o, info) in enumerate(starts):
        same(row(batch, i), o)
        same(row(infos, i), info)
    ended, ends = [False] * n, 0
    for action in actions:
        batch, reward, terminated, truncated, infos = venv.step(action)
        assert "final_info" in infos or not (terminated | truncated).any()
        for i, env in enumerate(envs):
            if ended[i]:
                o, info = env.reset()
                r, te, tu = 0.0, False, False
            else:
                o, r, te, tu, info = env.step(action[i])
            same(row(batch, i), o)
            same(row(infos, i), info)
            assert (reward[i], terminated[i], truncated[i]) == (r, te, tu)
            ended[i] = te or tu
            if ended[i]:
                ends += 1
                assert infos["_final_info"][i]
                same(row(infos["final_info"], i), info)
            elif "_final_info" in infos:
                assert not infos["_final_info"][i] and not infos["_episode_metrics"][i]
    assert ends >= 3


@pytest.mark.skipif(not NEW, reason="needs gymnasium >= 1.0")
@pytest.mark.parametrize("env_id", IDS)
def test_make_vec_gives_what_gymnasiums_own_vector_gives(env_id):
    """Observations, rewards, flags and the info's arrays, masks and dtypes of SyncVectorEnv."""
    kwargs = {"num_envs": 3, "task": SHORT}
    native = gym.make_vec(env_id, vectorization_mode="vector_entry_point", **kwargs)
    default = gym.make_vec(env_id, **kwargs)
    sync = gym.make_vec(env_id, vectorization_mode="sync", **kwargs)
    assert isinstance(native, SealVectorEnv) and isinstance(default, SealVectorEnv)
    assert native.metadata["autoreset_mode"] == sync.metadata["autoreset_mode"]
    assert native.spec.id == env_id
    assert native.observation_space == sync.observation_space
    assert native.action_space == sync.action_space
    rng = np.random.default_rng(0)
    for a, b in zip(native.reset(seed=3), sync.reset(seed=3), strict=True):
        same(a, b)
    for _ in range(25):
        action = rng.uniform(-1, 1, (3, 6)).astype(np.float32)
        mine, theirs = native.step(action), sync.step(action)
        info = {k: v for k, v in mine[4].items() if k.strip("_") != "final_info"}
        for a, b in zip(mine[:4], theirs[:4], strict=True):
            same(a, b)
        same(info, theirs[4])
    mask = np.array([True, False, True])
    options = {"reset_mask": mask}
    mine = native.reset(seed=[8, None, None], options=options)
    same(mine[0], (theirs := sync.reset(seed=[8, None, None], options=dict(options)))[0])
    same(mine[1], theirs[1])
    for venv in (native, default, sync):
        venv.close()


@pytest.mark.skipif(NEW, reason="about gymnasium 0.29")
def test_old_gymnasium_is_refused_with_a_way_out():
    with pytest.raises(SealGymError, match=r"gymnasium >= 1\.0.*make_sb3_vec"):
        SealVectorEnv(2)


@pytest.mark.parametrize("version", ["0.29.1", "0.26"])
def test_versions_before_1(version):
    with pytest.raises(SealGymError, match=r"gymnasium >= 1\.0"):
        require_gymnasium_1(version)
    require_gymnasium_1("1.0.0")
    require_gymnasium_1("1.4.0rc1")


def test_spaces_are_batched(make_vec):
    venv = make_vec(num_envs=4, observation="features+images", control="rmp")
    single = SealEnv(observation="features+images", control="rmp")
    assert venv.single_observation_space == single.observation_space
    assert venv.observation_space == batch_space(single.observation_space, 4)
    assert venv.action_space == batch_space(single.action_space, 4)
    observation, _ = venv.reset(seed=0)
    assert observation in venv.observation_space
    assert venv.metadata["autoreset_mode"] == (gym.vector.AutoresetMode.NEXT_STEP if NEW else "NextStep")


def test_seeds(make_vec):
    venv = make_vec()
    by_number, _ = venv.reset(seed=5)
    by_list, _ = venv.reset(seed=[5, 6, 7])
    np.testing.assert_array_equal(by_number, by_list)
    on, _ = venv.reset()
    assert (on != by_number).any(axis=1).all()
    venv.reset(seed=5)
    np.testing.assert_array_equal(venv.reset()[0], on)
    partly, _ = venv.reset(seed=[5, None, 7])
    np.testing.assert_array_equal(partly[[0, 2]], by_number[[0, 2]])
    assert (partly[1] != by_number[1]).any()
    assert len(set(map(id, venv.np_random))) == 3


def test_rows_without_a_seed_differ(make_vec):
    one, two = make_vec(), make_vec()
    starts = np.concatenate((one.reset()[0], two.reset()[0]))
    assert len(np.unique(starts, axis=0)) == 6


def test_reset_mask_resets_its_rows_only(make_vec):
    """The others go on as if nothing had been, their seam-rate filter included."""
    venv, plain = make_vec("SealGym/Cylinder-v0"), make_vec("SealGym/Cylinder-v0")
    action = np.full((3, 6), 0.02, np.float32)
    for v in (venv, plain):
        v.reset(seed=1)
        for _ in range(4):
            v.step(action)
    mask = np.array([False, True, False])
    observation, info = venv.reset(seed=[None, 9, None], options={"reset_mask": mask})
    same(observation[1], SealEnv(workpiece="cylinder").reset(seed=9)[0])
    np.testing.assert_array_equal(info["_tip_error_mm"], mask)
    np.testing.assert_array_equal(info["roi"]["_d_front_mm"], mask)
    assert info["tip_error_mm"][0] == 0.0 and info["renderer"][0] is None
    for _ in range(3):
        a, b = venv.step(action), plain.step(action)
        np.testing.assert_array_equal(a[0][[0, 2]], b[0][[0, 2]])
        np.testing.assert_array_equal(a[1][[0, 2]], b[1][[0, 2]])


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"seed": [1, 2]}, "2 entries"),
        ({"options": {"hover": 1}}, r"\['hover'\].*reset_mask"),
        ({"options": {"reset_mask": [True, False, False]}}, "boolean array"),
        ({"options": {"reset_mask": np.zeros(3, np.bool_)}}, "no row"),
        ({"options": {"reset_mask": np.ones(2, np.bool_)}}, r"shape \(3,\)"),
        ({"options": {"reset_mask": np.ones(3)}}, "boolean array"),
    ],
)
def test_wrong_resets(make_vec, kwargs, message):
    with pytest.raises(ConfigError, match=message):
        make_vec().reset(**kwargs)


@pytest.mark.parametrize(
    "kwargs", [{"num_envs": 0}, {"num_envs": 1.5}, {"colour": 1}, {"render_mode": "ansi"}]
)
def test_wrong_arguments(make_vec, kwargs):
    with pytest.raises(ConfigError, match=next(iter(kwargs))):
        make_vec(**kwargs)


def test_step_needs_every_row_reset(make_vec):
    venv = make_vec()
    with pytest.raises(gym.error.ResetNeeded):
        venv.step(np.zeros((3, 6)))
    venv.reset(options={"reset_mask": np.array([True, True, False])})
    with pytest.raises(gym.error.ResetNeeded):
        venv.step(np.zeros((3, 6)))


@pytest.mark.parametrize("bad", [np.zeros((3, 5)), np.zeros((2, 6)), np.zeros(6), np.full((3, 6), np.nan)])
def test_hostile_actions(make_vec, bad):
    venv = make_vec()
    venv.reset(seed=0)
    with pytest.raises(ActionError):
        venv.step(bad)
    venv.step(np.zeros((3, 6)))


def test_nothing_returned_shares_memory(make_vec):
    venv, clean = make_vec(), make_vec()

    def arrays(x):
        if isinstance(x, dict):
            return [leaf for value in x.values() for leaf in arrays(value)]
        return [x] if isinstance(x, np.ndarray) else []

    venv.reset(seed=0)
    clean.reset(seed=0)
    kept = []
    for _ in range(4):
        result, expected = venv.step(np.full((3, 6), 0.1)), clean.step(np.full((3, 6), 0.1))
        for x, y in zip(result, expected, strict=True):
            same(x, y)
        mine = [leaf for x in result for leaf in arrays(x)]
        for k, array in enumerate(mine):
            assert not any(np.shares_memory(array, other) for other in kept + mine[:k])
        kept += mine
        for array in mine:
            if array.dtype != object:
                array[...] = 1


def test_threads_change_nothing(make_vec):
    one, two = make_vec(num_envs=8), make_vec(num_envs=8, threads=2)
    rng = np.random.default_rng(0)
    one.reset(seed=0)
    two.reset(seed=0)
    for _ in range(5):
        action = rng.uniform(-1, 1, (8, 6))
        for a, b in zip(one.step(action)[:4], two.step(action)[:4], strict=True):
            np.testing.assert_array_equal(a, b)


def test_leaves_are_added_to_all_rows(make_vec):
    venv = make_vec(control="rmp")
    calls = []

    def leaf(state):
        calls.append(state.q.shape)
        return seal_gym_nothing(len(state.q))

    venv.add_leaf(leaf)
    venv.reset(seed=0)
    venv.step(np.zeros((3, 27)))
    assert calls == [(3, 6)]
    with pytest.raises(ActionError):
        make_vec().add_leaf(leaf)


def seal_gym_nothing(n):
    from seal_gym.rmp import Leaf

    zero = np.zeros((n, 6))
    return Leaf(np.tile(np.eye(6), (n, 1, 1)), zero, zero, np.zeros((n, 6, 6)))


def test_pickled_vectors_run_alike(make_vec):
    venv = make_vec(num_envs=2)
    copy = pickle.loads(pickle.dumps(venv))
    np.testing.assert_array_equal(venv.reset(seed=1)[0], copy.reset(seed=1)[0])
    copy.close()


def test_render_without_a_mode_warns(make_vec):
    venv = make_vec()
    venv.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert venv.render() is None


@pytest.mark.gl
def test_render_shows_row_0(make_vec):
    venv = make_vec(render_mode="rgb_array")
    venv.reset(seed=0)
    (picture,) = venv.render()
    single = SealEnv(render_mode="rgb_array")
    single.reset(seed=0)
    np.testing.assert_array_equal(picture, single.render())
    single.close()


def test_the_action_of_a_row_that_starts_anew_is_ignored(make_vec):
    venv = make_vec(task=SHORT)
    venv.reset(seed=0)
    truncated = np.zeros(3, np.bool_)
    while not truncated.all():
        _, _, _, truncated, _ = venv.step(np.zeros((3, 6)))
    observation, reward, terminated, truncated, _ = venv.step(np.full((3, 6), np.nan))
    assert np.isfinite(observation).all()
    assert not reward.any() and not (terminated | truncated).any()
    with pytest.raises(ActionError):
        venv.step(np.full((3, 6), np.nan))
