"""A ball drawn through a right angle leaves its own fillet; the tool path is the executed one, moved."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import axis_angle, transform
from seal_gym.sealant.bead import Bead
from seal_gym.sealant.config import SealantCfg
from seal_gym.sealant.smoothing import SmoothingCfg, smooth, tool_path
from tests.unit.sealant.plates import fillet

CFG = SmoothingCfg(radius_m=5e-3)


def filled(section_mm2, strip):
    """A right angle filled to one level."""
    bead = Bead(strip, 0.06, 1, SealantCfg(section_mm2=section_mm2, variation=0.0))
    bead.reset(0, np.zeros(3), np.random.default_rng(0))
    level = np.sqrt(section_mm2) * 1e-3
    bead.height[0] = np.maximum(level - np.abs(strip.across), 0.0)
    bead.volume[0] = strip.volume(bead.height[0])
    return bead


def draw(bead, cfg=CFG):
    s = np.arange(0.0, 0.06, 0.1e-3)
    centres = np.column_stack((0 * s, s, 0 * s + cfg.lift_m))
    return smooth(bead, 0, centres, s, cfg)


def test_the_ball_leaves_a_fillet_of_its_radius():
    strip = fillet()
    bead = filled(9.0, strip)
    before = bead.volume.sum()
    removed = draw(bead)
    middle = slice(80, 160)
    section = bead.volume[0, middle].sum(axis=1) / 0.25e-3
    # The square of a side R less a quarter of the circle: (1 - pi / 4) R^2.
    np.testing.assert_allclose(section, (1 - np.pi / 4) * 25e-6, rtol=0.02)
    assert bead.volume.sum() + removed == pytest.approx(before, rel=1e-12)
    x = strip.across
    inside = np.abs(x) < 5e-3 / np.sqrt(2) - 0.3e-3
    top = np.sqrt(2) * 5e-3 - np.sqrt(25e-6 - x[inside] ** 2)
    found = bead.height[0, 120, inside] + np.abs(x[inside])
    np.testing.assert_allclose(found, top, atol=2e-6)
    # It touches R from the corner on either side; d short of that the film is d^2 / (2 R) sqrt(2) high, and
    # 0.1 mm of it counts as wet, to a column of 0.35 mm along the wall.
    wet = 5e-3 - np.sqrt(0.1e-3 * 2 * 5e-3 / np.sqrt(2))
    np.testing.assert_allclose(bead.contact(0)[middle], wet, atol=0.36e-3)


def test_too_little_sealant_is_spread_and_none_is_left_over():
    bead = filled(3.0, fillet())
    # A string that stands in the corner, 1.25 mm wide.
    bead.height[0] = np.where(np.abs(bead.strip.across) < 0.7e-3, 2.4e-3, 0.0)
    bead.volume[0] = bead.strip.volume(bead.height[0])
    before, contact = bead.volume.sum(), bead.contact(0)[120].copy()
    removed = draw(bead)
    # What the ball pushes before it at the end is a tenth of a millimetre of bead.
    assert removed < 0.02 * before
    assert bead.volume.sum() + removed == pytest.approx(before, rel=1e-12)
    assert (bead.contact(0)[120] > contact + 0.5e-3).all()


def test_a_second_pass_changes_nothing_more():
    bead = filled(9.0, fillet())
    draw(bead)
    once = bead.height.copy()
    assert draw(bead) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(bead.height[0, 20:-20], once[0, 20:-20], atol=1e-9)


def executed(n=200, noise=0.0, seed=0):
    y = np.linspace(0.0, 0.06, n)
    rng = np.random.default_rng(seed)
    x = noise * rng.standard_normal(n)
    return transform(np.tile(np.eye(3), (n, 1, 1)), np.column_stack((x, y, 0 * y + 3e-3)))


def test_the_tool_path_is_the_executed_one_moved_along_the_nozzle():
    path = tool_path(executed(), 3e-3, 0.5e-3, CFG)
    np.testing.assert_allclose(path[:, 0, 3], 0.0, atol=1e-15)
    np.testing.assert_allclose(path[:, 2, 3], np.sqrt(2) * 5e-3)
    np.testing.assert_allclose(path[[0, -1], 1, 3], [0.0, 0.06], atol=1e-12)
    np.testing.assert_allclose(np.diff(path[:, 1, 3]), 0.5e-3, rtol=1e-9)


def test_shaking_is_averaged_out():
    shaky = executed(noise=0.2e-3)
    path = tool_path(shaky, 3e-3, 0.1e-3, SmoothingCfg(radius_m=5e-3, blend_m=10e-3))
    assert path[60:-60, 0, 3].std() < 0.5 * shaky[:, 0, 3].std()


def test_turned_poses_stay_rotations():
    poses = executed()
    for k in range(len(poses)):
        poses[k, :3, :3] = axis_angle(np.array([0.0, 0.0, 1.0]), 0.01 * k)
    path = tool_path(poses, 3e-3, 0.5e-3, CFG)
    turn = path[:, :3, :3]
    square = turn @ np.swapaxes(turn, 1, 2)
    np.testing.assert_allclose(square, np.broadcast_to(np.eye(3), turn.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turn), 1.0)


def test_bad_tools_are_named():
    with pytest.raises(ConfigError, match=r"radius_m = 5.5: must be above 0 and at most 0.02; check"):
        SmoothingCfg(radius_m=5.5)
