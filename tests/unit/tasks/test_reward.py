"""The reward against the formula of its docstring, worked out by hand."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.tasks.reward import RewardCfg, reward

NO = np.array([False])


def one(travel=0.0, error=0.0, previous=None, heading=0.0, change=0.0, reached=False, failed=False, cfg=None):
    previous = error if previous is None else previous
    values = [np.array([float(v)]) for v in (travel, error, previous, heading, change)]
    return float(reward(*values, np.array([reached]), np.array([failed]), cfg or RewardCfg())[0])


@pytest.mark.parametrize(
    ("kwargs", "expected"),
    [
        ({}, 0.0),
        ({"travel": 1.0}, 1.0),  # a nominal step on the path
        ({"travel": 5.0}, 1.0),  # hurrying gains nothing more
        ({"travel": 0.5, "error": 1e-3}, 0.25),  # 1 mm off halves it
        ({"travel": -0.5, "error": 1e-3}, 0.0),  # ground covered before is worth nothing
        ({"travel": 1.0, "error": 3e-3}, 0.1),
        ({"error": 0.0, "previous": 5e-3}, 1.0),  # 2 (1/2 - 0)
        ({"error": 5e-3, "previous": 0.0}, -1.0),
        ({"heading": 0.1}, -0.05),
        ({"heading": 3.0}, -0.1),
        ({"change": 1.0}, -0.05),
        ({"reached": True}, 20.0),
        ({"failed": True}, -20.0),
    ],
)
def test_each_term(kwargs, expected):
    assert one(**kwargs) == pytest.approx(expected, abs=1e-12)


def test_terms_add_up_with_their_weights():
    cfg = RewardCfg(progress=3, approach=5, heading=7, smoothness=11, reached=13, failed=17)
    value = one(0.5, 1e-3, 5e-3, 0.1, 0.25, True, True, cfg)
    expected = 3 * 0.5 * 0.5 + 5 * (0.5 - 1 / 6) - 7 * 0.5 - 11 * 0.25 + 13 - 17
    assert value == pytest.approx(expected, abs=1e-12)


def test_it_is_bounded_and_the_bound_is_near():
    rng = np.random.default_rng(0)
    n, cfg = 20_000, RewardCfg()
    value = reward(
        rng.normal(0, 5, n), rng.exponential(1e-2, n), rng.exponential(1e-2, n), rng.exponential(1, n),
        rng.random(n), rng.random(n) < 0.5, rng.random(n) < 0.5, cfg,
    )  # fmt: skip
    assert cfg.bound == pytest.approx(23.15)
    assert (np.abs(value) <= cfg.bound).all()
    assert one(1, 0, 1e9, 0, 0, True) == pytest.approx(cfg.bound - 0.15, rel=1e-6)


def test_without_new_ground_a_walk_that_ends_where_it_began_pays_nothing():
    rng = np.random.default_rng(1)
    for _ in range(50):
        e = np.concatenate(([2e-3], rng.exponential(2e-3, 20), [2e-3]))
        assert sum(one(0.0, e[k + 1], e[k]) for k in range(21)) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("name", list(RewardCfg.__dataclass_fields__))
@pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf")])
def test_config_ranges(name, bad):
    with pytest.raises(ConfigError, match=f"RewardCfg.{name}"):
        RewardCfg(**{name: bad})


@pytest.mark.parametrize("name", ["error_m", "heading_rad", "potential_m"])
def test_scales_must_not_be_zero(name):
    with pytest.raises(ConfigError, match="must be > 0"):
        RewardCfg(**{name: 0.0})
