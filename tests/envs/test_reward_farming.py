"""Scripted policies that try to earn more than sealing the seam pays."""

import gymnasium as gym
import numpy as np
import pytest

from agents.expert import RmpExpert
from seal_gym.workpieces.workpiece import Workpiece

R = np.sqrt(0.5)
LENGTH_M, SPEED_MM_S = 0.06, 10.0
NOMINAL_STEPS = LENGTH_M * 1e3 / SPEED_MM_S * 30
SCALE = np.array([1e3] * 3 + [np.rad2deg(25.0)] * 3)  # an action of 1 in mm/s2 and deg/s2


def steer(o, speed, offset=(0.0, 0.0)):
    """Tip acceleration that keeps to the seam, moved by an offset in x and z [mm], at a speed [mm/s]."""
    error = np.array([o[0] + offset[0], 0.0, o[3] + offset[1], o[4], o[10], -o[1]])
    goal = np.array([0.0, speed, 0.0, 0.0, 0.0, 0.0])
    gain = np.array([60.0, 0.0, 60.0, 60.0, 20.0, 60.0])
    return np.clip((gain * error + 11.0 * (goal - o[11:17])) / SCALE, -1.0, 1.0).astype(np.float32)


def seal(o, t, s):
    return steer(o, SPEED_MM_S)


def to_and_fro(o, t, s):
    """20 mm on, 20 mm back, all the episode long."""
    return steer(o, SPEED_MM_S if t % 4.0 < 2.0 else -SPEED_MM_S)


def inch(o, t, s):
    """Three steps on, two steps back."""
    return steer(o, SPEED_MM_S if t % 0.5 < 0.3 else -SPEED_MM_S)


def hover_before_the_end(o, t, s):
    return steer(o, np.clip(2.0 * (0.97 * LENGTH_M - s) * 1e3, -SPEED_MM_S, SPEED_MM_S))


def saw_before_the_end(o, t, s):
    """Stops short, then goes to and fro there."""
    back = -SPEED_MM_S if t % 1.0 < 0.5 else SPEED_MM_S
    return steer(o, SPEED_MM_S if s < 0.9 * LENGTH_M else back)


def creep(o, t, s):
    """So slowly that the time runs out."""
    return steer(o, 0.25 * SPEED_MM_S)


def circle(o, t, s):
    """Circles of 0.8 mm round a place in the middle of the seam."""
    phase = 2 * np.pi * t
    speed = SPEED_MM_S if s < 0.5 * LENGTH_M else 0.0
    return steer(o, speed, (0.8 * np.cos(phase), 0.8 * np.sin(phase)))


def bob(o, t, s):
    """Away from the path and back to it."""
    return steer(o, 0.0, (0.0, 6.0 if t % 2.0 < 1.0 else 0.0))


def skip_and_run_on(o, t, s):
    """Leaves the path for a tenth of the seam, so that it is never reached, and goes on past its end."""
    beyond = np.clip(2.0 * (1.4 * LENGTH_M - s) * 1e3, -SPEED_MM_S, SPEED_MM_S)
    return steer(o, beyond, (0.0, 7.0 if 0.4 * LENGTH_M < s < 0.6 * LENGTH_M else 0.0))


ATTACKS = (to_and_fro, inch, hover_before_the_end, saw_before_the_end, creep, circle, bob, skip_and_run_on)


@pytest.fixture(scope="module")
def part():
    return Workpiece.from_polyline([[-LENGTH_M / 2, 0, 0], [LENGTH_M / 2, 0, 0]], [0, -R, R], name="short")


def play(part, control, act, seed=500_000):
    env = gym.make("SealGym/Seal-v0", workpiece=part, control=control, perception="oracle")
    core = env.unwrapped.core
    observation, _ = env.reset(seed=seed)
    rewards, furthest, done = [], 0.0, False
    while not done:
        action = act(observation, len(rewards) / 30, float(core.progress.s[0]))
        observation, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        furthest = max(furthest, float(core.progress.s[0]))
        done = terminated or truncated
    env.close()
    return np.array(rewards), furthest, info["episode_metrics"]["outcome"]


@pytest.fixture(scope="module")
def finishing(part):
    expert = RmpExpert()
    rewards, _, outcome = play(part, "rmp", lambda o, t, s: expert.predict(o)[0])
    assert outcome == "reached"
    return rewards.sum()


def test_the_script_itself_can_finish(part, finishing):
    rewards, _, outcome = play(part, "tip", seal)
    assert outcome == "reached"
    assert rewards.sum() == pytest.approx(finishing, rel=0.1)


@pytest.mark.parametrize("attack", ATTACKS)
def test_no_attack_earns_more_than_finishing(part, finishing, attack):
    rewards, furthest, outcome = play(part, "tip", attack)
    assert outcome == "timeout"
    assert rewards.sum() < finishing - 10.0
    # Nor more than the ground it gained is worth, with the way down from the hover (at most 2).
    assert rewards.sum() <= min(furthest / LENGTH_M, 1.0) * NOMINAL_STEPS + 2.0 + 1.0


def test_ground_past_the_end_pays_nothing(part):
    """Before there was a stop to it, this earned more than the expert did."""
    rewards, furthest, _ = play(part, "tip", skip_and_run_on)
    assert furthest > LENGTH_M + 0.02  # it went there
    assert rewards[int(1.1 * NOMINAL_STEPS) :].max() <= 0.01
