"""Light: grey levels of the images against the shading formula, the shadow's place against the geometry."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import transform
from seal_gym.sim.look import Look, LookCfg
from seal_gym.sim.raycast import Raycaster
from seal_gym.workpieces.surface import PLATE, Surface
from seal_gym.wrappers.lighting import Lamp, LightingCfg

CELL = load_cell()
FREE = {**LookCfg.clean().__dict__, "clip_fraction": 1.0}  # no exposure: grey levels are as shaded
STILL = np.zeros(6, np.float32)


def still_run(make, steps=150, **lighting):
    """Images under a gun that stands still, and the looks they were taken with."""
    env = make(
        observation="features+images",
        look=LookCfg(**FREE),
        disturbances=[{"name": "Lighting", "shadow": 0.0, **lighting}],
    )
    core = env.unwrapped.core
    images, looks = [env.reset(seed=4)[0]["front"].astype(float)], []
    for _ in range(steps):
        looks.append({k: v[0].copy() for k, v in core.sensors.look._asdict().items()})
        images.append(env.step(STILL)[0]["front"].astype(float))
    return np.array(images), looks


def test_the_level_multiplies_the_grey_levels(make):
    """All of the part's pixels by the same factor, within the amplitude, and smoothly."""
    images, _ = still_run(make, contrast=0.0, direction=0.0, level=0.3, severity=1.0)
    lit = images[0] > 60
    factor = (images / np.maximum(images[0], 1.0))[:, lit]
    middle = np.median(factor, axis=1)
    assert np.abs(factor - middle[:, None]).max() < 0.03  # rounding of about 100 grey levels
    assert np.abs(middle - 1.0).max() <= 0.3 + 0.01 and np.abs(middle - 1.0).max() > 0.1
    assert np.abs(np.diff(middle)).max() <= 0.3 * 0.7 / 30 + 0.01


def test_contrast_stretches_the_grey_levels_about_the_middle(make):
    images, _ = still_run(make, contrast=0.4, direction=0.0, level=0.0, steps=300)
    start = images[0] - 127.5
    free = np.abs(start) < 80
    gains = [np.sum((i[free] - 127.5) * start[free]) / np.sum(start[free] ** 2) for i in images]
    residual = [np.abs(i[free] - 127.5 - g * start[free]).max() for i, g in zip(images, gains, strict=True)]
    assert max(residual) < 1.6
    assert 0.08 < np.abs(np.array(gains) - 1.0).max() <= 0.4 + 0.01


def test_direction_turns_the_lamp_smoothly_within_its_bounds(make):
    images, looks = still_run(make, contrast=0.0, direction=0.2, level=0.0, severity=2.0, steps=300)
    lamps = np.array([k["lamp"] for k in looks])
    np.testing.assert_allclose(np.linalg.norm(lamps, axis=1), 1.0, atol=1e-12)
    slopes = lamps[:, :2] / lamps[:, 2:]
    moved = np.linalg.norm(slopes - slopes[0], axis=1)
    assert 0.15 < moved.max() <= 0.4 + 1e-9
    assert np.linalg.norm(np.diff(slopes, axis=0), axis=1).max() <= 0.4 * 0.7 / 30 + 1e-9
    assert np.abs(images[-1] - images[0]).max() > 5


def test_light_starts_from_the_runs_own_look(make):
    bare = make(observation="features+images")
    env = make(observation="features+images", disturbances=[{"name": "Lighting", "shadow": 0.0}])
    for seed in (2, None):
        a, b = (e.reset(seed=seed)[0] for e in (bare, env))
        np.testing.assert_array_equal(a["front"], b["front"])


def test_large_severities_stay_valid():
    lamp, look = Lamp(1, LightingCfg(severity=10.0)), Look.empty(1)
    look.draw(0, np.random.default_rng(0), LookCfg())
    for seed in range(20):
        lamp.reset(0, np.random.default_rng(seed), look)
        fresh = Look(*(v.copy() for v in look))
        for t in np.linspace(0, 60, 200):
            lamp.shine(fresh, np.array([t]))
            assert fresh.ambient[0] > 0 and fresh.diffuse[0] > 0 and fresh.contrast[0] >= -0.9
            assert fresh.lamp[0, 2] > 0 and 0 < fresh.shadow[0, 5] <= 0.95


# -- shadow -------------------------------------------------------------------------------------------------


def plane_under(camera_index, depth=0.1):
    """One big triangle across the camera's view at a depth, and the pose that puts its frame there."""
    camera = CELL.cameras[camera_index]
    corners = np.array([[-1.0, -1.0, depth], [1.0, -1.0, depth], [0.0, 1.0, depth]])
    corners = corners if np.linalg.det(corners) < 0 else corners[::-1]
    surface = Surface(triangles=corners[None], material=np.array([PLATE], np.int32))
    return surface, transform(camera.rotation, camera.position_m)[None], camera


@pytest.mark.parametrize("view", [0, 1])
def test_the_shadow_lies_where_its_planes_cut_the_part(view):
    depth, dark = 0.1, 0.4
    surface, part, camera = plane_under(view, depth)
    look = Look.empty(1)
    look.draw(0, np.random.default_rng(0), LookCfg(**FREE))
    caster = Raycaster(surface, CELL, np.empty((0, 3, 3)))

    def picture():
        images = caster.render(np.eye(4)[None], part, look, np.zeros(1, np.uint64))
        return (images.front, images.side)[view][0].astype(float)

    lit = picture()
    rng = np.random.default_rng(view)
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ray = np.stack((columns, rows), axis=-1) - camera.centre_px
    points = np.concatenate((ray / camera.focal_px * depth, np.full((*rows.shape, 1), depth)), axis=-1)
    tip = points @ camera.rotation.T + camera.position_m
    for _ in range(5):
        normal = camera.rotation @ np.append(rng.standard_normal(2), 0.2)
        normal /= np.linalg.norm(normal)
        offset = float(np.median(tip @ normal))
        look.shadow[0] = (*normal, offset, 3e-3, dark)
        away = np.abs(tip @ normal - offset) - 3e-3
        ratio = picture() / lit
        assert np.abs(ratio[away > 6e-4] - 1.0).max() < 1e-9
        assert np.abs(ratio[away < -6e-4] - (1.0 - dark)).max() < 0.02
        assert (away > 6e-4).any() and (away < -6e-4).any()


def test_the_shadow_comes_from_outside_and_crosses_the_view(make):
    env = make(
        observation="features+images",
        look=LookCfg(**FREE),
        disturbances=[{"name": "Lighting", "level": 0.0, "contrast": 0.0, "direction": 0.0}],
    )
    first = env.reset(seed=4)[0]["front"].astype(float)
    bare = make(observation="features+images", look=LookCfg(**FREE)).reset(seed=4)[0]["front"]
    np.testing.assert_array_equal(first, bare)
    share = []
    for _ in range(200):
        now = env.step(STILL)[0]["front"].astype(float)
        share.append(np.mean(now.mean(axis=-1) < 0.85 * first.mean(axis=-1)))
    assert max(share) > 0.1 and min(share) == 0.0
    # Two crossings in a swing of 6 to 10 s: seen at least once in 5 s, and gone again.
    assert np.sum(np.diff(np.array(share) > 0.02) != 0) >= 2


@pytest.mark.parametrize("wrong", [{"level": 1.1}, {"contrast": -0.1}, {"direction": 9.0}, {"shadow": 1.0}])
def test_values_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        LightingCfg(**wrong)
