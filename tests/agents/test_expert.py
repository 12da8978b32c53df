import gymnasium as gym
import numpy as np
import pytest

import agents
import seal_gym  # noqa: F401  # registers the ids
from seal_gym.core.errors import ConfigError
from seal_gym.envs.adapters import CHOLESKY_SCALE
from seal_gym.rmp import cholesky_metric


def observation(**values):
    """Features of a tip on the seam at nominal speed, with changes by index."""
    row = np.zeros(35, np.float32)
    row[[2, 5]] = 1.0
    row[12] = 10.0
    for name, value in values.items():
        row[int(name[1:])] = value
    return row


def accel(action):
    return action[:6] * [1.0, 1.0, 1.0, 25.0, 25.0, 25.0]


@pytest.fixture
def expert():
    return agents.load_policy("rmp_expert")


@pytest.mark.parametrize(
    ("change", "axis", "sign"),
    [
        ({"i0": 1.0}, 0, +1),  # the seam lies to the right: accelerate to the right
        ({"i3": -1.0}, 2, -1),  # the tip is too high: accelerate down
        ({"i1": 2.0}, 5, -1),  # the seam bends to the right: turn right, negative about z
        ({"i4": 2.0}, 3, +1),  # the seam rises: tilt up, positive about x
        ({"i12": 5.0}, 1, +1),  # too slow: accelerate along y
        ({"i11": 5.0}, 0, -1),  # drifting to the right: brake
    ],
)
def test_it_acts_against_each_error(expert, change, axis, sign):
    rest, _ = expert.predict(observation())
    action, _ = expert.predict(observation(**change))
    assert sign * (accel(action) - accel(rest))[axis] > 0.01
    others = [k for k in range(6) if k != axis]
    np.testing.assert_allclose(accel(action)[others], accel(rest)[others], atol=1e-5)


def test_on_the_seam_at_speed_it_does_nothing(expert):
    action, _ = expert.predict(observation())
    np.testing.assert_allclose(accel(action), 0.0, atol=1e-6)


def test_its_metric_is_symmetric_and_positive_semi_definite(expert):
    rng = np.random.default_rng(0)
    rows = np.stack(
        [observation(**{f"i{k}": v for k, v in enumerate(rng.normal(size=17))}) for _ in range(20)]
    )
    actions, _ = expert.predict(rows)
    metric = cholesky_metric(CHOLESKY_SCALE * actions[:, 6:].astype(float))
    assert np.linalg.eigvalsh(metric).min() > -1e-9


def test_a_lost_view_slows_it_down(expert):
    action, _ = expert.predict(observation(i2=0.0))
    assert accel(action)[1] < -0.01


def test_single_and_batch_agree_to_the_bit(expert):
    rows = np.random.default_rng(1).normal(size=(9, 35)).astype(np.float32)
    batch, state = expert.predict(rows, state="kept")
    assert state == "kept"
    for row, action in zip(rows, batch, strict=True):
        np.testing.assert_array_equal(expert.predict(row)[0], action)
    np.testing.assert_array_equal(expert.predict({"features": rows})[0], batch)


def test_names_and_control_modes_are_checked():
    with pytest.raises(ConfigError, match=r"policy = 'rmp'.*rmp_expert"):
        agents.load_policy("rmp")
    env = gym.make("SealGym/Flat-v0", control="tip")
    with pytest.raises(ConfigError, match="control='rmp'"):
        agents.load_policy("rmp_expert", env)
    assert agents.control_of("rmp_expert") == "rmp"
