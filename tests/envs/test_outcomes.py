"""How episodes end, and their figures against an independent computation from the recorded tip."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import seal_gym
from seal_gym.tasks.progress import SealTaskCfg
from seal_gym.tasks.reward import RewardCfg

IDS = seal_gym.ENV_IDS
LEAN = np.sqrt(0.5) * 3e-3  # the tip path stands this far out and up from the seam
STEP = 1e-6


def arc(centre, radius, angle):
    return np.column_stack((centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)))


def desired_path(name):
    """Samples of the desired tip path in the part's frame, a micrometre apart, and their seam arc length.

    From the protocol's description of the parts alone.
    """
    if name == "flat":
        s = np.arange(-0.02, 0.32, STEP)
        xy = np.column_stack((s - 0.15, np.full_like(s, -LEAN)))
        length = 0.3
    elif name == "cylinder":
        length = np.pi * 0.07
        s = np.arange(-0.02, length + 0.02, STEP)
        xy = arc((0, 0), 0.07 + LEAN, s / 0.07 - np.pi / 2)
    else:
        r, x0, x1, y = 5e-3, -0.055, 0.060, 0.07715
        side, back, quarter = x1 - r - x0, 2 * (y - r), np.pi / 2 * r
        length = 2 * (side + quarter) + back
        s = np.arange(-0.02, length + 0.02, STEP)
        ends = np.cumsum([side, quarter, back, quarter])
        one, c1, two, c2, three = np.split(s, np.searchsorted(s, ends))
        xy = np.concatenate(
            (
                np.column_stack((x0 + one, np.full_like(one, -y - LEAN))),
                arc((x1 - r, -y + r), r + LEAN, (c1 - ends[0]) / r - np.pi / 2),
                np.column_stack((np.full_like(two, x1 + LEAN), -y + r + two - ends[1])),
                arc((x1 - r, y - r), r + LEAN, (c2 - ends[2]) / r),
                np.column_stack((x1 - r - (three - ends[3]), np.full_like(three, y + LEAN))),
            )
        )
    return np.column_stack((xy, np.full(len(s), LEAN))), s, length


def part_of(env_id):
    name = env_id.removeprefix("SealGym/").removesuffix("-v0").lower()
    return "flat" if name == "seal" else name


# -- outcomes -----------------------------------------------------------------------------------------------


def run(env, action, steps=150, seed=0):
    env.reset(seed=seed)
    for _ in range(steps):
        result = env.step(np.asarray(action, np.float32))
        if result[2] or result[3]:
            return result
    pytest.fail("the episode did not end")


def flags(info):
    m = info["episode_metrics"]
    return m["outcome"], m["reached"], m["collision"], m["timeout"]


@pytest.mark.parametrize("env_id", IDS)
def test_driven_into_the_plate_is_a_collision(make, env_id):
    env = make(env_id)
    _, reward, terminated, truncated, info = run(env, [0, 0, -0.3, 0, 0, 0])
    assert terminated and not truncated
    assert info["collision"] and not info["reached"] and not info["is_success"]
    assert flags(info) == ("collision", False, True, False)
    assert info["episode_metrics"]["rmse_mm"] is None  # not NaN: infos must equal themselves
    assert info["episode_metrics"]["coverage_pct"] < 5.0
    touching = {name for pair in env.unwrapped.core.arm.contacts(0) for name in pair}
    assert any("nozzle" in name for name in touching) and any("part" in name for name in touching)
    assert -RewardCfg().bound <= reward < -15


@pytest.mark.parametrize("env_id", IDS)
def test_driven_away_is_lost_at_25_mm(make, env_id):
    env = make(env_id)
    _, reward, terminated, truncated, info = run(env, [0, 0, 0.3, 0, 0, 0])
    assert terminated and not truncated
    assert not info["collision"] and not info["reached"]
    assert flags(info) == ("lost", False, False, True)
    assert 25.0 < info["tip_error_mm"] < 25.0 + 1e3 * 0.3 * 0.5 / 30  # it went at < 0.5 m/s
    assert reward < -15


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("control", ["tip", "joint"])
def test_idling_ends_in_a_timeout_and_the_arm_stays(make, env_id, control):
    env = make(env_id, control=control, task=SealTaskCfg(time_factor=0.02))
    env.reset(seed=0)
    core = env.unwrapped.core
    start = core.tip.pose[0, :3, 3].copy()
    length = desired_path(part_of(env_id))[2]
    limit = int(np.ceil(0.02 * length / 0.01 * 30 - 1e-4))
    for k in range(limit):
        *_, terminated, truncated, info = env.step(np.zeros(6, np.float32))
        assert not terminated
        assert truncated == (k == limit - 1)
    assert flags(info) == ("timeout", False, False, True)
    assert info["episode_metrics"]["time_s"] == pytest.approx(limit / 30)
    assert np.linalg.norm(core.tip.pose[0, :3, 3] - start) < 0.1e-3


def test_idling_rmp_creeps_on_but_does_not_reach(make):
    """With A = 0 the fixed leaves alone act: damping to the reference twist carries the gun along."""
    env = make(control="rmp", task=SealTaskCfg(time_factor=0.05))
    *_, truncated, info = run(env, np.zeros(27))
    assert truncated and info["episode_metrics"]["outcome"] == "timeout"


def test_three_times_the_nominal_time(make):
    assert make("SealGym/Flat-v0").unwrapped.core.time_limit == 2700
    assert make("SealGym/Cylinder-v0").unwrapped.core.time_limit == int(np.ceil(9000 * np.pi * 0.07))


# -- the expert's episodes ----------------------------------------------------------------------------------


def test_the_expert_reaches(episode):
    m = episode.metrics
    assert episode.terminated and not episode.truncated
    assert (m["outcome"], m["reached"], m["collision"], m["timeout"]) == ("reached", True, False, False)
    last = episode.infos[-1]
    assert last["reached"] and last["is_success"] and last["progress"] == 1.0
    assert not any(info["reached"] or "episode_metrics" in info for info in episode.infos[:-1])
    assert m["rmse_mm"] < (0.15 if "Rect" in episode.env_id else 0.05)
    assert m["time_s"] == pytest.approx(len(episode.actions) / 30)
    nominal = desired_path(part_of(episode.env_id))[2] / 0.01
    assert nominal - 0.5 < m["time_s"] < 1.1 * nominal + 2


def test_metrics_against_dense_sampling(episode):
    path, s, length = desired_path(part_of(episode.env_id))
    tips = episode.tips[:, :3, 3]
    error, index = cKDTree(path).query(tips)
    travel = s[index]
    steps = error[1:]
    settled = np.maximum.accumulate(travel[1:] >= 0.010)
    m = episode.metrics
    assert 1e-3 * m["rmse_whole_mm"] == pytest.approx(np.sqrt(np.mean(steps**2)), abs=1.5e-6, rel=1e-3)
    assert 1e-3 * m["rmse_mm"] == pytest.approx(np.sqrt(np.mean(steps[settled] ** 2)), abs=1.5e-6)
    # Coverage: arc (in samples of 0.1 mm) with a point of the tip's track, drawn between frames, within 1 mm.
    between = np.linspace(0, 1, 8, endpoint=False)[:, None, None]
    track = (tips[:-1] + between * (tips[1:] - tips[:-1])).reshape(-1, 3)
    sealed = path[(s >= 0) & (s <= length)][::100]
    covered = cKDTree(track).query(sealed)[0] <= 1e-3
    assert m["coverage_pct"] == pytest.approx(100 * covered.mean(), abs=1.0)
    for k in range(0, len(tips), 25):
        info = episode.infos[k]
        assert 1e-3 * info["tip_error_mm"] == pytest.approx(error[k], abs=2e-6)
        assert info["progress"] == pytest.approx(np.clip(travel[k] / length, 0, 1), abs=2e-4)


def test_progress_never_jumps(episode):
    progress = np.array([info["progress"] for info in episode.infos])
    length = desired_path(part_of(episode.env_id))[2]
    assert np.diff(progress).max() * length < 1.5e-3  # 0.33 mm a frame at nominal speed
    assert progress[0] < 0.01 and progress[-1] == 1.0
    # The seam is 12 mm away at the start: no share of it is travelled by coming down.
    assert (np.diff(progress) > -0.003).all()


def test_features_are_the_seams_tangent_at_the_point_nearest_the_tip(episode):
    """Oracle truth: the tangent line of the analytic seam in the recorded tip frame."""
    path, _, _ = desired_path(part_of(episode.env_id))
    seam = path - [0, 0, LEAN]
    tree = cKDTree(path)
    for k in range(40, len(episode.tips) - 1, 60):
        tip = episode.tips[k]
        i = int(tree.query(tip[:3, 3])[1])
        near = path[max(i - 50, 0)], path[i + 50]
        tangent = (near[1] - near[0]) / np.linalg.norm(near[1] - near[0])
        out = np.cross(tangent, [0, 0, 1.0])  # right of travel, where the nozzle leans
        point = seam[i] - LEAN * out
        p, d = tip[:3, :3].T @ (point - tip[:3, 3]), tip[:3, :3].T @ tangent
        p = p - d * p[1] / d[1]
        expected = [1e3 * p[0], np.rad2deg(np.arctan2(d[0], d[1])), 1.0]
        expected += [1e3 * (p[2] + 3e-3), np.rad2deg(np.arctan2(d[2], d[1])), 1.0]
        # The seam is a polyline of half a degree a piece where it bends.
        np.testing.assert_allclose(episode.observations[k, :6], expected, atol=0.02)


def test_the_reward_by_hand(flat_episode):
    """On the flat part everything is closed form: r = ground x quality + potential - heading - jumps + 20."""
    e = flat_episode
    x, y, z = e.tips[:, :3, 3].T
    s, error = x + 0.15, np.hypot(y + LEAN, z - LEAN)
    travel = np.clip(np.diff(np.maximum.accumulate(s)) / (0.010 / 30), 0, 1)
    quality = 1 / (1 + (error[1:] / 1e-3) ** 2)
    potential = error / (error + 5e-3)
    heading = np.minimum(1.0, np.abs(np.deg2rad(e.observations[:-1, [1, 4]])).max(axis=1) / 0.2)
    actions = np.vstack((np.zeros(27), np.array(e.actions, np.float64)))
    jump = np.abs(np.diff(actions, axis=0)).mean(axis=1) / 2
    expected = travel * quality - 2 * np.diff(potential) - 0.1 * heading - 0.05 * jump
    expected[-1] += 20
    np.testing.assert_allclose(e.rewards, expected, atol=1e-6)


def test_rewards_are_bounded_and_a_sealed_seam_pays(episode):
    rewards = np.array(episode.rewards)
    assert (np.abs(rewards) <= RewardCfg().bound).all()
    length = desired_path(part_of(episode.env_id))[2]
    assert rewards.sum() > 20 + 0.8 * length / (0.010 / 30)
