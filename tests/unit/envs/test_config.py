"""The keyword arguments in one place."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError, SealGymError
from seal_gym.envs.adapters import JointAdapter, RmpAdapter, TipAdapter, make_adapter
from seal_gym.envs.config import SealCfg, check_num_envs
from seal_gym.workpieces import catalogue


def test_defaults():
    cfg = SealCfg()
    assert (cfg.workpiece, cfg.control, cfg.observation, cfg.renderer) == (
        "flat",
        "tip",
        "features",
        "raycast",
    )
    assert (cfg.leaves, cfg.threads) == ((), 1)


def test_of_takes_the_attributes_and_nothing_else():
    cfg = SealCfg.of(workpiece=catalogue.cylinder(), control="rmp", leaves=[print], threads=2)
    assert cfg.leaves == (print,)
    assert cfg.workpiece is catalogue.cylinder()
    with pytest.raises(ConfigError, match=r"\['colour', 'size'\].*'workpiece'"):
        SealCfg.of(size=1, colour=2)


@pytest.mark.parametrize("threads", [0, -1, 257, 1.0, "2", None])
def test_threads(threads):
    with pytest.raises(ConfigError, match=r"threads = .*1\.\.256"):
        SealCfg(threads=threads)
    assert SealCfg(threads=np.int64(2)).threads == 2


@pytest.mark.parametrize("n", [0, -1, 2.0, "2", None])
def test_num_envs(n):
    with pytest.raises(ConfigError, match="num_envs = "):
        check_num_envs(n)
    check_num_envs(1)


@pytest.mark.parametrize("name", ["control", "perception", "observation", "renderer", "workpiece"])
@pytest.mark.parametrize("bad", ["nonsense", 3, None])
def test_choices_are_listed(name, bad):
    with pytest.raises(SealGymError, match=rf"{name} = {bad!r}: must be one of \["):
        SealCfg(**{name: bad})


@pytest.mark.parametrize(
    ("control", "cls"), [("tip", TipAdapter), ("rmp", RmpAdapter), ("joint", JointAdapter)]
)
def test_adapters(control, cls):
    assert isinstance(make_adapter(control, SealCfg().cell, ()), cls)


def test_adapter_errors():
    with pytest.raises(ConfigError, match="must be one of"):
        make_adapter("torque", SealCfg().cell, ())
    with pytest.raises(ConfigError, match="control='rmp'"):
        make_adapter("tip", SealCfg().cell, (print,))


def test_joint_adapter_scales():
    out = JointAdapter(SealCfg().cell)(np.array([[0.5, -1, 0, 0, 0, 1.0]]), None)
    np.testing.assert_array_equal(out, [[7.5, -15, 0, 0, 0, 15]])


@pytest.mark.parametrize("gain", [-0.1, 1.5, np.nan, "much", None])
def test_seam_rate_gain(gain):
    with pytest.raises(ConfigError, match=r"seam_rate_gain = .*0\.\.1"):
        SealCfg(seam_rate_gain=gain)
    assert SealCfg(seam_rate_gain=0).seam_rate_gain == 0
