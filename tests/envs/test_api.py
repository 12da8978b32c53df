"""What Gymnasium and Stable-Baselines3 require of every id, control and observation kind."""

import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import seal_gym
from seal_gym.core.errors import ActionError, ConfigError, SealGymError
from seal_gym.envs.core import OBSERVATION_ROWS
from seal_gym.envs.seal_env import SealEnv

IDS = seal_gym.ENV_IDS
CONTROLS = {"tip": 6, "rmp": 27, "joint": 6}
OBSERVATIONS = ("features", "features+images")
EVERY = [
    pytest.param(i, c, o, id=f"{i.removeprefix('SealGym/')}-{c}-{o}")
    for i in IDS
    for c in CONTROLS
    for o in OBSERVATIONS
]


@pytest.mark.parametrize(("env_id", "control", "observation"), EVERY)
def test_gymnasiums_check_env_has_nothing_to_say(make, env_id, control, observation):
    """Warnings are errors here (pyproject.toml)."""
    check_env(make(env_id, control=control, observation=observation).unwrapped, skip_render_check=True)


@pytest.mark.parametrize(("env_id", "control", "observation"), EVERY)
def test_sb3s_check_env_has_nothing_to_say(make, env_id, control, observation):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(make(env_id, control=control, observation=observation), warn=True)


@pytest.mark.parametrize(("env_id", "control", "observation"), EVERY)
def test_spaces(make, env_id, control, observation):
    env = make(env_id, control=control, observation=observation)
    size = CONTROLS[control]
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (size,), np.float32)
    space = env.observation_space
    if observation == "features+images":
        assert list(space.spaces) == ["features", "front", "side"]
        assert space["front"] == gym.spaces.Box(0, 255, (100, 50, 3), np.uint8)
        assert space["side"] == gym.spaces.Box(0, 255, (50, 100, 3), np.uint8)
        space = space["features"]
    assert space.shape == (35,) and space.dtype == np.float32
    assert np.flatnonzero(space.low == 0).tolist() == [2, 5]  # the validity flags


@pytest.mark.parametrize("env_id", IDS)
def test_bare_environments_reset_and_step(env_id):
    """Without the passive checker's wrapper, and with the module prefix of gym.make."""
    env = gym.make(f"seal_gym:{env_id}", disable_env_checker=True)
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    assert info["progress"] == pytest.approx(0.0, abs=0.01)
    env.close()
    env.close()


def test_import_is_light():
    """Registering pulls in neither physics, compiler, renderer nor learning library."""
    code = "import sys, seal_gym; print([m for m in sys.argv[1:] if m in sys.modules])"
    heavy = ["torch", "mujoco", "numba", "stable_baselines3", "scipy"]  # gymnasium 0.29 loads cv2 itself
    out = subprocess.run([sys.executable, "-c", code, *heavy], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_an_environment_needs_no_sb3_and_no_torch():
    code = (
        "import sys, gymnasium as gym, seal_gym; e = gym.make('SealGym/Flat-v0'); e.reset(seed=0);"
        "print([m for m in ('torch', 'stable_baselines3') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


# -- names and arguments ------------------------------------------------------------------------------------


def test_workpiece_of_each_id(make):
    for env_id, name in zip(IDS, ("flat", "cylinder", "rectangular", "flat"), strict=True):
        assert make(env_id).unwrapped.core.scene.workpiece.name == name
    seal = make("SealGym/Seal-v0", workpiece="cylinder")
    assert seal.unwrapped.core.scene.workpiece.name == "cylinder"


def test_a_workpiece_of_the_users_own(make):
    points = [[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]]
    lean = np.sqrt(0.5)
    mine = seal_gym.Workpiece.from_polyline(points, [0.0, -lean, lean], name="mine")
    env = make("SealGym/Seal-v0", workpiece=mine)
    env.reset(seed=0)
    assert env.unwrapped.core.scene.workpiece is mine
    assert env.unwrapped.core.time_limit == 900  # 3 x 10 s x 30 Hz


@pytest.mark.parametrize(
    ("kwargs", "names"),
    [
        ({"control": "torque"}, ["tip", "rmp", "joint"]),
        ({"perception": "lidar"}, ["oracle"]),
        ({"observation": "images"}, ["features", "features+images"]),
        ({"renderer": "vulkan"}, ["raycast", "gl"]),
        ({"workpiece": "sphere"}, ["flat", "cylinder", "rectangular"]),
        ({"render_mode": "ansi"}, ["rgb_array", "human"]),
        ({"colour": "red"}, ["workpiece", "control", "observation", "leaves"]),
        ({"threads": 0}, ["1..256"]),
        ({"threads": 1.5}, ["1..256"]),
        ({"control": "tip", "leaves": [lambda s: None]}, ["control='rmp'"]),
    ],
)
def test_wrong_arguments_list_the_right_ones(kwargs, names):
    with pytest.raises(SealGymError) as error:
        SealEnv(**kwargs)
    assert isinstance(error.value, ValueError)
    for name in [*names, next(iter(kwargs)) if "leaves" not in kwargs else "leaves"]:
        assert name in str(error.value)


def test_wrong_arguments_through_gym_make():
    with pytest.raises(ConfigError, match="unknown keyword argument"):
        gym.make("SealGym/Flat-v0", colour="red")


def test_an_unknown_id_is_refused():
    with pytest.raises(gym.error.UnregisteredEnv):
        gym.make("SealGym/Sphere-v0")


def test_reset_takes_no_options(make):
    env = make()
    env.reset(seed=0, options={})
    with pytest.raises(ConfigError, match="options"):
        env.reset(options={"hover": 1})


def test_step_before_reset_is_refused():
    with pytest.raises(gym.error.ResetNeeded):
        SealEnv().step(np.zeros(6))
    with pytest.raises(gym.error.ResetNeeded):
        gym.make("SealGym/Flat-v0").step(np.zeros(6, np.float32))


# -- hostile actions ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("control", CONTROLS)
def test_wrong_shapes_are_refused(control):
    env, size = SealEnv(control=control), CONTROLS[control]
    env.reset(seed=0)
    for bad in (np.zeros(size + 1), np.zeros(size - 1), np.zeros((1, size)), np.zeros(()), 0.0, []):
        with pytest.raises(ActionError, match=rf"{control}.*\({size},\)"):
            env.step(bad)


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_actions_that_are_not_finite_are_refused_and_change_nothing(control, value):
    env, other = SealEnv(control=control), SealEnv(control=control)
    size = CONTROLS[control]
    env.reset(seed=3)
    other.reset(seed=3)
    bad = np.zeros(size)
    bad[size // 2] = value
    with pytest.raises(ActionError, match="must be finite"):
        env.step(bad)
    good = np.full(size, 0.1)
    np.testing.assert_array_equal(env.step(good)[0], other.step(good)[0])


@pytest.mark.parametrize("control", CONTROLS)
def test_out_of_range_is_clipped(control):
    size = CONTROLS[control]
    action = np.random.default_rng(0).choice([-1.0, 1.0, 0.3], size)
    beyond = np.where(np.abs(action) == 1.0, 1e30 * action, action)
    results = []
    for a in (action, beyond):
        env = SealEnv(control=control)
        env.reset(seed=1)
        results.append(env.step(a))
    np.testing.assert_array_equal(results[0][0], results[1][0])
    assert results[0][1:4] == results[1][1:4]
    assert np.isfinite(results[0][0]).all()


# -- info ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_info_and_observation_tell_the_same(make, observation):
    env = make("SealGym/Cylinder-v0", observation=observation)
    rows, infos, rng = [], [], np.random.default_rng(0)
    o, info = env.reset(seed=5)
    for _ in range(8):
        rows.append(o if observation == "features" else o["features"])
        infos.append(info)
        o, _, _, _, info = env.step(rng.uniform(-0.1, 0.1, 6).astype(np.float32))
    names = [
        "tip_error_mm",
        "progress",
        "collision",
        "reached",
        "is_success",
        "renderer",
        "seam_velocity",
        "roi",
    ]
    for row, info in zip(rows, infos, strict=True):
        assert list(info)[: len(names)] == names
        assert np.isfinite(info["snr_db"]).all()
        roi = info["roi"]
        expected = [
            roi["d_front_mm"], np.rad2deg(roi["theta_front_rad"]), roi["valid_front"],
            roi["d_side_mm"], np.rad2deg(roi["theta_side_rad"]), roi["valid_side"],
            *1e3 * info["seam_velocity"][[0, 2]], *np.rad2deg(info["seam_velocity"][[3, 5]]),
        ]  # fmt: skip
        np.testing.assert_allclose(row[:10], expected, rtol=1e-6, atol=1e-9)
        assert roi["valid_front"] is True and isinstance(info["progress"], float)
        assert info["renderer"] == "raycast"


def test_the_documented_table_is_the_observation():
    """The class docstring's table has a row for each of OBSERVATION_ROWS, at its index."""
    index = 0
    for _, _, bound, count in OBSERVATION_ROWS:
        where = f"{index}" if count == 1 else f"{index}-{index + count - 1}"
        line = next(x for x in SealEnv.__doc__.splitlines() if x.strip().startswith(f"| {where} |"))
        assert line.rstrip().endswith(f"| {bound:g} |")
        index += count
    assert index == 35


# -- pickling and pictures ----------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("control", CONTROLS)
def test_pickled_environments_run_alike(make, env_id, control):
    env = make(env_id, control=control).unwrapped
    copy = pickle.loads(pickle.dumps(env))
    assert copy.observation_space == env.observation_space
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(env.reset(seed=9)[0], copy.reset(seed=9)[0])
    for _ in range(5):
        action = rng.uniform(-1, 1, env.action_space.shape)
        a, b = env.step(action), copy.step(action)
        np.testing.assert_array_equal(a[0], b[0])
        assert a[1:4] == b[1:4]


def test_render_without_a_mode_warns_and_gives_nothing():
    env = SealEnv()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


@pytest.mark.gl
@pytest.mark.parametrize("env_id", IDS)
def test_rgb_array(make, env_id):
    env = make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (720, 1280, 3) and first.dtype == np.uint8
    assert first.std() > 10
    for _ in range(10):
        env.step(np.array([0, 0, 0.5, 0, 0, 0], np.float32))
    assert np.abs(env.render().astype(int) - first).max() > 20
    assert first.flags.owndata or first.base is None or not np.shares_memory(first, env.render())


@pytest.mark.gl
def test_rendering_does_not_change_the_run(make):
    plain, shown = make(), make(render_mode="rgb_array")
    plain.reset(seed=4)
    shown.reset(seed=4)
    for _ in range(3):
        shown.render()
        a, b = plain.step(np.full(6, 0.05, np.float32)), shown.step(np.full(6, 0.05, np.float32))
        np.testing.assert_array_equal(a[0], b[0])
        assert a[4].keys() == b[4].keys()
