"""The palette environment: interface, determinism, contacts, and the scripted policy."""

import math
import pickle
from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import seal_gym
from agents import load_policy
from agents.palette_expert import Memory, PaletteExpert, PaletteExpertCfg
from seal_gym.core.errors import ActionError, ConfigError
from seal_gym.core.frames import transform
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.envs.palette_config import PlacementCfg
from seal_gym.envs.palette_env import PALETTE_ROWS, WRONG, PaletteEnv
from seal_gym.planning.tau_jerk import RateLimitsCfg
from seal_gym.vision import palette_threshold
from seal_gym.vision.palette_seen import Regions
from seal_gym.vision.palette_segments import PaletteClass
from seal_gym.workpieces.palette import BOARD_M, MAX_TARGETS, LayoutCfg, draw_layout


@pytest.fixture
def make():
    made = []

    def build(**kwargs):
        made.append(gym.make(seal_gym.PALETTE_ID, disable_env_checker=True, **kwargs).unwrapped)
        return made[-1]

    yield build
    for env in made:
        env.close()


# -- interface ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("control", ["tip", "joint"])
@pytest.mark.parametrize("observation", ["features", "features+images"])
@pytest.mark.parametrize("perception", ["vision", "oracle"])
def test_gymnasiums_check_env_has_nothing_to_say(make, control, observation, perception):
    check_env(make(control=control, observation=observation, perception=perception), skip_render_check=True)


def test_sb3s_check_env_has_nothing_to_say(make):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(make(), warn=True)


def test_two_environments_repeat_each_other_to_the_bit_also_without_a_seed(make):
    a, b = make(observation="features+images"), make(observation="features+images")
    rng = np.random.default_rng(0)
    for seed in (7, None, None):
        (first, _), (second, _) = a.reset(seed=seed), b.reset(seed=seed)
        for _ in range(25):
            for name in first:
                np.testing.assert_array_equal(first[name], second[name])
            action = rng.uniform(-1, 1, 6).astype(np.float32)
            (first, *x), (second, *y) = a.step(action), b.step(action)
            assert x[:3] == y[:3]


def test_a_picture_more_or_less_changes_no_run(make):
    """Images and vision draw nothing from ``np_random``; an extra look only uses up sensor noise."""
    plain, seeing = make(perception="oracle"), make(perception="oracle", observation="features+images")
    for seed in (3, None):
        a, _ = plain.reset(seed=seed)
        b, _ = seeing.reset(seed=seed)
        np.testing.assert_array_equal(a, b["features"])
        plain.look()


def test_no_observation_element_is_constant_and_none_leaves_its_bounds(make):
    env = make(observation="features+images", perception="oracle", control="joint")
    rows, images = [], []
    rng = np.random.default_rng(1)
    for seed in range(25):
        observation, _ = env.reset(seed=seed)
        images.append(observation["depth_m"])
        action = rng.uniform(-1, 1, 6).astype(np.float32)
        for _ in range(6):
            rows.append(observation["features"])
            assert observation in env.observation_space
            observation, *_ = env.step(action)
    # Touch a tie and bring it home: force and openness vary by what is done.
    for seed in (500_000, 500_001):
        rows += _played(env, seed)[1]
    spread = np.ptp(np.array(rows), axis=0)
    names = [f"{name}[{k}]" for name, _, _, n in PALETTE_ROWS for k in range(n)]
    assert [n for n, s in zip(names, spread, strict=True) if s == 0] == []
    assert np.ptp(images, axis=0).max() > 0.01


def test_the_documented_table_is_the_observation():
    index = 0
    for _, _, bound, count in PALETTE_ROWS:
        where = f"{index}" if count == 1 else f"{index}-{index + count - 1}"
        line = next(x for x in PaletteEnv.__doc__.splitlines() if x.strip().startswith(f"| {where} |"))
        assert line.rstrip().endswith(f"| {bound:g} |")
        index += count
    assert index == PaletteEnv().observation_space.shape[0] == 57


def test_observations_share_no_memory(make):
    env = make(observation="features+images")
    first, _ = env.reset(seed=0)
    kept = {k: v.copy() for k, v in first.items()}
    second, *_ = env.step(np.ones(6, np.float32))
    for name, value in first.items():
        np.testing.assert_array_equal(value, kept[name])
        assert not np.shares_memory(value, second[name])


def test_pickled_environments_run_alike(make):
    env = make(control="joint", perception="oracle")
    copy = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(env.reset(seed=5)[0], copy.reset(seed=5)[0])
    action = np.full(6, 0.3, np.float32)
    np.testing.assert_array_equal(env.step(action)[0], copy.step(action)[0])


def test_wrong_use_is_refused(make):
    with pytest.raises(gym.error.ResetNeeded):
        make().step(np.zeros(6))
    with pytest.raises(ConfigError, match="unknown keyword argument"):
        PaletteEnv(colour="red")
    with pytest.raises(ConfigError, match=r"tip.*joint"):
        PaletteEnv(control="rmp")
    with pytest.raises(ConfigError, match="function"):
        PaletteEnv(observer="hopfield")
    env = make(perception="oracle")
    env.reset(seed=0)
    with pytest.raises(ActionError, match="shape"):
        env.step(np.zeros(5))
    with pytest.raises(ActionError, match="finite"):
        env.step(np.full(6, np.nan))
    with pytest.raises(ConfigError, match="options"):
        env.reset(options={"x": 1})
    with pytest.raises(ConfigError, match="no picture"):
        _ = env.picture


def test_out_of_range_is_clipped(make):
    a, b = make(perception="oracle"), make(perception="oracle")
    a.reset(seed=1)
    b.reset(seed=1)
    np.testing.assert_array_equal(a.step(np.ones(6))[0], b.step(np.full(6, 1e30))[0])


# -- what is seen -------------------------------------------------------------------------------------------


def test_the_places_are_the_targets_seen_from_the_tip(make):
    env = make(perception="oracle")
    observation, info = env.reset(seed=2)
    tip = tip_kinematics(env.arm.q, env.arm.qd).pose[0]
    n = len(env.target_m)
    expected = (np.linalg.inv(tip) @ np.column_stack((env.target_m, np.ones(n))).T)[:3].T
    np.testing.assert_allclose(observation[: 3 * n].reshape(-1, 3), 1e3 * expected, rtol=1e-5, atol=1e-3)
    assert not observation[3 * n : 24].any()
    assert observation[24:32].tolist() == [1.0] * n + [0.0] * (MAX_TARGETS - n)
    assert info["targets"] == n and info["progress"] == 0.0


@pytest.mark.parametrize(("name", "largest_m"), [("hopfield", 0.004), ("threshold", 0.006)])
def test_observers_find_the_targets_under_the_sensor_realism(make, name, largest_m):
    env = make() if name == "hopfield" else make(observer=palette_threshold.observe)
    for seed in range(500_000, 500_020):
        env.reset(seed=seed)
        away = np.linalg.norm(env.place_m[:, None] - env.target_m, axis=2)
        assert away.shape[0] == away.shape[1], seed
        assert away.min(axis=0).max() < largest_m and len(set(away.argmin(axis=0))) == len(env.target_m)


def test_the_tie_observer_tells_the_palette_from_the_table(make):
    env = make()
    env.reset(seed=0)
    observer = env.cfg.observer
    seen = observer.report(env.picture.rgb, env.picture.depth_m, env.cfg.camera)
    layout = env.scene.layout
    assert len(seen.of(PaletteClass.RIVET)) == len(layout.rivets)
    assert len(seen.of(PaletteClass.CONNECTOR)) == len(layout.connectors)
    board = env.part_pose[:3, 3]
    assert np.linalg.norm(seen.positions_m[:, :2] - board[:2], axis=1).max() < np.hypot(*BOARD_M[:2]) / 2
    with pytest.raises(ConfigError, match="floor_m"):
        replace(observer, floor_m=5.0).report(env.picture.rgb, env.picture.depth_m, env.cfg.camera)
    with pytest.raises(ConfigError, match="floor_m"):
        replace(observer, floor_m=math.nan)


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (None, r"NoneType.*shape \(n, 3\)"),
        (Regions(np.zeros((2, 3)), ("tie",)), "1 classes"),
        (Regions(np.zeros((3, 2)), ("tie",) * 3), r"shape \(3, 2\)"),
        (Regions(np.full((1, 3), np.nan), ("tie",)), "finite"),
    ],
)
def test_an_observer_that_gives_nonsense_is_named(make, seen, message):
    with pytest.raises(ConfigError, match=message):
        make(observer=lambda rgb, depth_m, camera: seen).reset(seed=0)


@pytest.mark.parametrize(
    "build",
    [
        lambda: LayoutCfg(targets=4),
        lambda: LayoutCfg(targets=(4,)),
        lambda: LayoutCfg(targets=(math.nan, 8)),
        lambda: LayoutCfg(connector_height_m=0.02),
        lambda: LayoutCfg(apart_m="x"),
        lambda: PlacementCfg(home_m=3),
        lambda: PaletteEnv(control=np.array(["tip"])),
    ],
)
def test_values_of_the_wrong_kind_are_named(build):
    with pytest.raises(ConfigError, match="must be"):
        build()


def test_the_table_stops_the_arm_as_anything_else(make):
    """The tool is driven straight down beside the palette: MuJoCo's own contact force is the truth."""
    env = make(control="tip", perception="oracle")
    env.reset(seed=500_000)
    largest = 0.0
    for _ in range(300):
        *_, terminated, _, info = env.step(np.array([0, 0, -0.2, 0, 0, 0], np.float32))
        if terminated:
            break
    assert terminated and info["collision"] and info["touched"] == ["other"]
    assert info["episode_metrics"]["peak_force_n"] >= 150.0 and info["episode_metrics"]["wrong_other"] == 1
    data = env.arm.data(0)
    for k in range(data.ncon):
        force = np.zeros(6)
        mujoco.mj_contactForce(env.scene.model, data, k, force)
        largest = max(largest, float(np.linalg.norm(force[:3])))
    assert largest > 50.0
    for _ in range(5):  # what has ended stays as it ended
        _, earned, terminated, truncated, again = env.step(np.array([0, 0, 1, 0, 0, 0], np.float32))
        assert (earned, terminated, truncated, again["collision"]) == (0.0, True, False, True)


def test_the_expert_is_told_of_the_wrong_control(make):
    with pytest.raises(ConfigError, match="control='joint'"):
        PaletteExpert.of(make(control="tip"))
    with pytest.raises(ConfigError, match="PaletteExpert"):
        load_policy("rmp_expert", make())


def test_any_observer_can_be_used(make):
    calls = []

    def observer(rgb, depth_m, camera):
        calls.append((rgb.shape, depth_m.shape, camera.frame_px))
        points = np.array([[0.4, 0.0, 0.0], [0.45, 0.1, 0.0], [0.5, 0.0, 0.0]])
        return Regions(points, ("cable", "target", "tie"))

    env = make(observer=observer)
    env.reset(seed=0)
    assert calls == [((480, 400, 3), (480, 400), (400, 480))]
    np.testing.assert_array_equal(env.place_m, [[0.45, 0.1, 0.0], [0.5, 0.0, 0.0]])


def test_the_picture_has_gaps_and_noise_and_shows_the_palette(make):
    env = make()
    env.reset(seed=0)
    picture = env.picture
    assert 0.005 < np.isnan(picture.depth_m).mean() < 0.02
    other = env.look()
    both = np.isfinite(picture.depth_m) & np.isfinite(other.depth_m)
    assert np.std((picture.depth_m - other.depth_m)[both]) == pytest.approx(1e-3 * np.sqrt(2), rel=0.05)
    difference = picture.rgb.astype(float) - other.rgb
    unclipped = (np.minimum(picture.rgb, other.rgb) > 20) & (np.maximum(picture.rgb, other.rgb) < 235)
    assert np.std(difference[unclipped]) == pytest.approx(8.0 * np.sqrt(2), rel=0.05)
    clipped = ((picture.rgb == 0) | (picture.rgb == 255)).any(axis=2)
    assert clipped.mean() <= 0.02


# -- contacts -----------------------------------------------------------------------------------------------


class Driver(PaletteExpert):
    """Goes straight over a point and down onto it, past everything."""

    def __init__(self, point, below_m, speed=0.05):
        super().__init__(cfg=PaletteExpertCfg(press=RateLimitsCfg(speed=speed, acceleration=1.0, jerk=20.0)))
        self._point, self._below = point, below_m

    def start(self, observation):
        memory = Memory(q=observation[45:51].astype(float), qd=np.zeros(6))
        tip = tip_kinematics(memory.q[None], np.zeros((1, 6))).pose[0]
        q, ways = memory.q, []
        for goal in (self._point + np.array([0, 0, 0.08]), self._point - np.array([0, 0, self._below])):
            pose = transform(np.eye(3), goal)
            ways.append(self._straight(q, tip, pose, self._cfg.press if ways else self._cfg.move))
            q, tip = ways[-1].q[-1], pose
        return Memory(q=memory.q, qd=memory.qd, ways=tuple(ways), place=0)

    def _think(self, rows, memory):
        return memory


def _drive(env, seed, point, below_m, frames=300):
    observation, _ = env.reset(seed=seed)
    driver = Driver(point(env), below_m)
    memory, infos = driver.start(observation), []
    for _ in range(frames):
        action, memory = driver._follow(memory)
        *_, terminated, truncated, info = env.step(action)
        infos.append(info)
        if terminated or truncated or not memory.ways:
            break
    return infos


def _in_world(env, points):
    return points @ env.part_pose[:3, :3].T + env.part_pose[:3, 3]


def _bare_cable(env):
    """A point of a cable away from all ties and connectors."""
    layout = env.scene.layout
    points = np.concatenate([line[2:-2] for line in layout.cables])
    spots = np.array([s[:2] for s in (*layout.targets, *layout.seated, *layout.connectors)])
    away = np.linalg.norm(points[:, None, :2] - spots, axis=2).min(axis=1)
    return _in_world(env, points[np.argmax(away)] + [0, 0, 0.004])


def _connector(env):
    spot, height = env.scene.layout.connectors[0], env.scene.layout.connector_height_m[0]
    return _in_world(env, np.array([spot.x, spot.y, height]))


def _rivet(env):
    return _in_world(env, np.array([*env.scene.layout.rivets[0], 0.003]))


def _peg(env):
    return _in_world(env, env.scene.layout.pegs[0])


def _board(env):
    grid = np.stack(np.meshgrid(np.linspace(-0.16, 0.16, 33), np.linspace(-0.11, 0.11, 23)), -1).reshape(
        -1, 2
    )
    layout = env.scene.layout
    spots = np.array([s[:2] for s in (*layout.targets, *layout.seated, *layout.connectors)])
    things = np.concatenate((np.concatenate(layout.cables)[:, :2], layout.rivets, layout.pegs[:, :2], spots))
    best = grid[np.argmax(np.linalg.norm(grid[:, None] - things, axis=2).min(axis=1))]
    return _in_world(env, np.array([*best, 0.0]))


def _seated(env):
    spot = env.scene.layout.seated[0]
    return _in_world(env, np.array([spot.x, spot.y, 0.014]))


@pytest.mark.parametrize(
    ("name", "point"),
    [
        ("cable", _bare_cable),
        ("connector", _connector),
        ("peg", _peg),
        ("rivet", _rivet),
        ("board", _board),
        ("tie", _seated),
    ],
)
def test_a_wrong_touch_is_noticed_and_named(make, name, point):
    infos = _drive(make(control="joint", perception="oracle"), 500_001, point, 0.002)
    assert infos[-1]["wrong_touches"] == 1
    assert next(i["touched"] for i in infos if i["touched"]) == [name]
    assert not infos[-1]["is_success"] and infos[-1]["targets_done"] == 0


def test_hovering_touches_nothing(make):
    infos = _drive(make(control="joint", perception="oracle"), 500_001, _connector, -0.002)
    assert infos[-1]["wrong_touches"] == 0 and infos[-1]["force_n"] == 0.0


def test_too_hard_a_hit_stops_the_arm(make):
    infos = _drive(make(control="joint", perception="oracle"), 500_001, _connector, 0.03)
    assert infos[-1]["collision"]
    metrics = infos[-1]["episode_metrics"]
    assert metrics["outcome"] == "collision" and metrics["peak_force_n"] >= 150.0
    assert metrics["wrong_connector"] == 1 and metrics["targets_done"] == 0


def _target(env):
    return env.target_m[0]


def test_a_tie_pressed_short_of_its_seat_springs_back_and_is_not_home(make):
    """About 4 mm down, above the seat, the pad feels the spring's 3 N and 1 N/mm: below 15 N."""
    env = make(control="joint", perception="oracle")
    infos = _drive(env, 500_000, _target, 0.004)
    assert infos[-1]["targets_done"] == 0 and infos[-1]["wrong_touches"] == 0
    slide = -env.arm.data(0).qpos[6:]
    assert 0.003 < slide[0] < 0.0045 and np.abs(slide[1:]).max() < 5e-4
    assert infos[-1]["force_n"] == pytest.approx(3.0 + 1000.0 * slide[0], abs=0.7)


def test_a_tie_counts_with_force_at_its_seat_only(make):
    """At the seat the spring gives 9 N: not home with a threshold above what the press reaches, else home."""
    from seal_gym.tasks.pressing import PressTaskCfg

    done = {}
    for threshold in (15.0, 80.0):
        env = make(control="joint", perception="oracle", task=PressTaskCfg(force_n=threshold))
        infos = _drive(env, 500_000, _target, 0.008)
        done[threshold] = (infos[-1]["targets_done"], max(i["force_n"] for i in infos))
    assert done[15.0][0] == 1 and done[80.0][0] == 0
    assert 15.0 < done[80.0][1] < 80.0


def test_a_tie_that_is_home_stays_down(make):
    env = make(control="joint", perception="oracle")
    _played(env, 500_000)
    np.testing.assert_allclose(-env.arm.data(0).qpos[6:], 0.006, atol=1.5e-3)


# -- the scripted policy ------------------------------------------------------------------------------------


def _played(env, seed):
    policy, memory, done = PaletteExpert(), None, False
    observation, _ = env.reset(seed=seed)
    rows, tips, commands, earned = [], [env.tip.pose[0, :3, 3].copy()], [], 0.0
    memory = None
    while not done:
        rows.append(observation["features"] if isinstance(observation, dict) else observation)
        if env.cfg.control == "joint":
            action, memory = policy.predict(observation, memory)
        else:
            action = np.zeros(6, np.float32)
        observation, r, terminated, truncated, info = env.step(action)
        tips.append(env.tip.pose[0, :3, 3].copy())
        commands.append(tip_kinematics(env.arm.q_command, env.arm.qd_command).pose[0, :3, 3].copy())
        earned += r
        done = terminated or truncated
    return info, rows, np.array(tips), np.array(commands), earned


@pytest.mark.parametrize("perception", ["oracle", "vision"])
def test_the_expert_brings_all_ties_home_and_touches_nothing_else(make, perception):
    env = make(control="joint", perception=perception)
    info, _, tips, commands, earned = _played(env, 500_003)
    metrics = info["episode_metrics"]
    assert info["is_success"] and metrics["outcome"] == "reached"
    assert metrics["targets_done"] == metrics["targets"] == len(env.target_m)
    assert metrics["wrong_touches"] == sum(metrics[f"wrong_{name}"] for name in WRONG) == 0
    assert metrics["path_mm"] == pytest.approx(1e3 * np.linalg.norm(np.diff(tips, axis=0), axis=1).sum())
    jerk = np.linalg.norm(np.diff(commands, n=3, axis=0), axis=1).max() * 30**3
    assert metrics["peak_jerk_m_s3"] == pytest.approx(jerk, rel=0.05)
    assert 15.0 <= metrics["peak_force_n"] < 100.0
    assert metrics["time_s"] == pytest.approx((len(tips) - 1) / 30)
    assert earned > 10.0 * metrics["targets"]


def test_the_episode_goes_on_unpaid_after_its_end(make):
    env = make(control="joint", perception="oracle")
    _played(env, 500_000)
    assert env.step(np.zeros(6, np.float32))[1] == 0.0


def test_an_idle_policy_times_out(make):
    env = make(perception="oracle", layout=LayoutCfg(targets=(1, 1)))
    info, rows, *_ = _played(env, 0)
    metrics = info["episode_metrics"]
    assert metrics["timeout"] and metrics["outcome"] == "timeout" and metrics["time_s"] == pytest.approx(18.0)
    assert len(rows) == 540 and metrics["path_mm"] < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("perception", "least"), [("oracle", 98), ("vision", 95)])
def test_a_hundred_palettes(make, perception, least):
    env = make(control="joint", perception=perception)
    good = sum(_played(env, 500_000 + k)[0]["is_success"] for k in range(100))
    assert good >= least


# -- layouts ------------------------------------------------------------------------------------------------


def test_layouts_keep_their_distances():
    for seed in range(40):
        layout = draw_layout(np.random.default_rng(seed))
        ties = np.array([s[:2] for s in (*layout.targets, *layout.seated)])
        apart = np.linalg.norm(ties[:, None] - ties, axis=2) + 9 * np.eye(len(ties))
        assert apart.min() >= 0.045 and 4 <= len(layout.targets) <= 8 and 1 <= len(layout.seated) <= 3
        lines = np.concatenate(layout.cables)[:, :2]
        assert np.linalg.norm(ties[:, None] - lines, axis=2).min(axis=1).max() < 1e-12  # on the cables
        assert np.abs(lines).max(axis=0)[0] <= 0.16 and np.abs(lines).max(axis=0)[1] <= 0.11
        assert len({tuple(s) for s in layout.targets}) == len(layout.targets)


def test_impossible_layouts_are_refused():
    with pytest.raises(ConfigError, match="room"):
        draw_layout(np.random.default_rng(0), LayoutCfg(targets=(8, 8), seated=(4, 4), apart_m=0.1))
    with pytest.raises(ConfigError, match="targets"):
        LayoutCfg(targets=(0, 9))


@pytest.mark.gl
def test_rgb_array(make):
    env = make(render_mode="rgb_array", perception="oracle")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (720, 1280, 3) and picture.dtype == np.uint8 and picture.std() > 10
