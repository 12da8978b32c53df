"""Environments that see by vision."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from agents.expert import RmpExpert
from seal_gym.core.cell import load_cell
from seal_gym.envs.adapters import make_adapter
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.wrappers import dynamic_regime


def roll(n, seeds, frames=25, observation="features"):
    core = SealCore(SealCfg(control="rmp", perception="vision", observation=observation), n)
    for i, seed in enumerate(seeds):
        core.reset(i, np.random.default_rng(seed))
    expert, out = RmpExpert(), []
    for _ in range(frames):
        seen = core.observe()
        out.append(seen if observation == "features" else seen["features"])
        core.step(expert.predict(out[-1])[0])
    return np.array(out), core


def test_one_and_eight_agree_to_the_bit():
    seeds = range(500_000, 500_008)
    many, _ = roll(8, seeds)
    for i in (0, 3, 7):
        one, _ = roll(1, [seeds[i]])
        np.testing.assert_array_equal(many[:, i], one[:, 0])
    np.testing.assert_array_equal(many, roll(8, seeds)[0])


def test_images_in_the_observation_change_nothing():
    with_images, core = roll(2, [1, 2], observation="features+images")
    np.testing.assert_array_equal(with_images, roll(2, [1, 2])[0])
    assert core.snr_db is not None and core.snr_db.shape == (2, 2)


@pytest.mark.parametrize("part", ["flat", "cylinder", "rectangular"])
def test_the_expert_seals_by_vision(part):
    env = gym.make("SealGym/Seal-v0", workpiece=part, control="rmp", perception="vision")
    expert, done = RmpExpert(), False
    observation, info = env.reset(seed=500_000)
    assert np.isfinite(info["snr_db"]).all()
    while not done:
        action, _ = expert.predict(observation)
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    env.close()
    assert info["episode_metrics"]["outcome"] == "reached"
    assert info["episode_metrics"]["rmse_mm"] < 0.15


def test_the_oracle_without_images_measures_no_noise():
    env = gym.make("SealGym/Flat-v0", perception="oracle")
    assert "snr_db" not in env.reset(seed=0)[1]
    env.close()


@pytest.mark.parametrize("part", ["flat", "cylinder", "rectangular"])
def test_a_gun_that_waits_stays_on_the_seam(part):
    """For 8 s, without travel to show it the seam behind the tip; it once swayed by 14 deg."""
    cell = load_cell()
    core = SealCore(SealCfg.of(workpiece=part, control="rmp", perception="vision"), 4)
    for i in range(4):
        core.reset(i, np.random.default_rng(500_008 + i))
    still = replace(cell, process=replace(cell.process, speed_m_s=1e-4))
    expert, waiting, errors, turning = RmpExpert(cell), RmpExpert(still), [], []
    for k in range(400):
        core.step((expert if k < 150 else waiting).predict(core.observe())[0])
        if k == 150:
            core.adapter = make_adapter("rmp", still, ())
        if k >= 170:
            errors.append(1e3 * core.progress.error_m)
            turning.append(np.degrees(core.tip.twist[:, 3:]))
    assert np.max(errors) < 0.2
    assert np.abs(turning).max() < 20.0


def test_a_start_in_odd_light_finds_the_seams_direction():
    """The first frames show edges ahead of the tip alone: heading and bend once traded places here."""
    core = SealCore(
        SealCfg.of(
            workpiece="cylinder", control="rmp", perception="vision", disturbances=dynamic_regime(1.0)
        ),
        1,
    )
    core.reset(0, np.random.default_rng(530_058))
    expert, thetas = RmpExpert(), []
    for _ in range(12):
        core.step(expert.predict(core.observe())[0])
        thetas.append(np.degrees(core.features.theta_rad[0]))
    assert np.abs(thetas).max() < 15.0  # 28 deg, and a collision
    assert np.abs(thetas[-1]).max() < 3.0


class Curtain:
    """Something between the cameras and the seam for a few frames of an episode."""

    def __init__(self, core, start, frames, change):
        self.sensors, self.see = core.sensors, core.sensors.images
        self.start, self.frames, self.change = start, frames, change
        self.sensors.images = self.images

    def images(self, pose, arm, frame, bead=None):
        seen = self.see(pose, arm, frame, bead)
        k = int(frame[0]) - self.start
        if not 0 <= k < self.frames:
            return seen
        views = [seen.front.copy(), seen.side.copy()]
        for view in views:
            self.change(view[0], k, self.frames)
        return seen._replace(front=views[0], side=views[1])


def nothing(view, k, n):
    view[:] = 120


def hand(view, k, n):
    """Skin with a wavy outline, from one side of the view to the other."""
    rng, (height, width, _) = np.random.default_rng(k), view.shape
    left = int(k / n * (width + 60)) - 60
    for y in range(height):
        a = left + int(8 * np.sin(y / 9))
        span = slice(max(a, 0), max(min(a + 60, width), 0))
        view[y, span] = np.clip(rng.normal([200, 150, 120], 8, view[y, span].shape), 0, 255)


def shadow(view, k, n):
    """A dark band that moves along the columns."""
    left = k / n * (view.shape[1] + 30) - 30
    x = np.arange(view.shape[1])
    view[:] = np.where(((x > left) & (x < left + 30))[None, :, None], 0.45 * view, view)


@pytest.mark.parametrize(
    ("change", "frames", "blind"),
    [(nothing, 9, (0, 1)), (nothing, 18, (9, 18)), (hand, 30, (1, 30)), (shadow, 30, (1, 30))],
)
@pytest.mark.parametrize(("part", "start"), [("flat", 300), ("rectangular", 325)])
def test_what_hides_the_seam_stops_the_gun_and_does_not_lead_it_astray(part, start, change, frames, blind):
    """On a straight, and at the box's first corner."""
    env = gym.make("SealGym/Seal-v0", workpiece=part, control="rmp", disable_env_checker=True)
    core, expert = env.unwrapped.core, RmpExpert()
    Curtain(core, start, frames, change)
    observation, _ = env.reset(seed=500_004)
    invalid, speed, error = 0, [], []
    for k in range(start + frames + 60):
        observation, _, terminated, _, info = env.step(expert.predict(observation)[0])
        assert not terminated
        if k >= start:
            invalid += not (observation[2] and observation[5])
            speed.append(float(observation[12]))
            error.append(info["tip_error_mm"])
    env.close()
    assert blind[0] <= invalid <= blind[1]
    assert max(error) < 1.0  # contact is 1.06 mm away
    assert max(speed) < 25.0  # mm/s along the seam: no dash
    if invalid > 6:
        assert min(speed) < 4.0
    assert observation[2] and observation[5] and abs(np.mean(speed[-15:]) - 10.0) < 0.5


def test_a_seam_that_leaves_the_view_is_invalid_and_the_gun_stays():
    env = gym.make("SealGym/Flat-v0", control="rmp", disable_env_checker=True)
    core, expert = env.unwrapped.core, RmpExpert()
    observation, _ = env.reset(seed=500_003)
    for _ in range(150):
        observation = env.step(expert.predict(observation)[0])[0]
    pose = core.arm.part_pose[0].copy()
    pose[2, 3] -= 0.1  # the part is taken away
    core.arm.place_part(0, pose)
    place = core.tip.pose[0, :3, 3].copy()
    for _ in range(60):
        observation = env.step(expert.predict(observation)[0])[0]
    env.close()
    assert not observation[2] and not observation[5]
    assert np.linalg.norm(core.tip.pose[0, :3, 3] - place) < 0.01
    assert np.abs(observation[11:14]).max() < 1.0  # mm/s
