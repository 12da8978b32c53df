from dataclasses import replace

import mujoco
import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import axis_angle, transform, yaw_pose
from seal_gym.sim.depth import DepthCfg, DepthSensor
from seal_gym.sim.gun_room import tip_poses
from seal_gym.sim.reach import check_reach
from seal_gym.sim.scene import GUN_PREFIX, cached_scene
from seal_gym.workpieces import catalogue

CLEAN = DepthCfg(sigma_m=0.0, dropout=0.0)


def scene_of(name):
    return cached_scene(catalogue.get(name), load_cell())


def nudged(pose):
    """A tip pose a little off, as it is in a run."""
    turn = axis_angle(np.array([1.0, 0.0, 0.0]), 0.05) @ axis_angle(np.array([0.0, 0.0, 1.0]), -0.06)
    return pose @ transform(turn, np.array([0.002, 0.001, 0.004]))


def looked_at(name, s, cfg=CLEAN):
    """A sensor, the tip in the part's frame at an arc length, and one profile of the part where it stands."""
    scene = scene_of(name)
    sensor = DepthSensor(scene, cfg)
    part = yaw_pose(0.42, -0.03, -0.05, 0.4)
    tip = nudged(tip_poses(scene, np.array([s]))[0])
    profile = sensor.measure((part @ tip)[None], part[None], [np.random.default_rng(0)])
    return sensor, tip, profile


def rays(sensor, tip, cfg):
    """Origin and unit directions in the part's frame, from the configuration's own words."""
    aim = np.array([0.0, cfg.look_ahead_m, -0.003])
    origin = np.array(cfg.origin_m)
    offsets = np.linspace(-0.5, 0.5, cfg.points)[:, None] * [cfg.width_m, 0.0, 0.0]
    directions = aim + offsets - origin
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return tip[:3, :3] @ origin + tip[:3, 3], directions @ tip[:3, :3].T


def plane(origin, directions, axis, value):
    t = (value - origin[axis]) / directions[:, axis]
    return np.where(t > 0, t, np.inf)


def ranges(profile):
    return np.hypot(profile.across_m[0], profile.depth_m[0])


def test_flat_fillet_is_two_planes():
    sensor, tip, profile = looked_at("flat", 0.1)
    origin, directions = rays(sensor, tip, CLEAN)
    expected = np.minimum(plane(origin, directions, 2, 0.0), plane(origin, directions, 1, 0.0))
    np.testing.assert_allclose(ranges(profile), expected, atol=1e-8)


def test_cylinder_is_a_cylinder():
    sensor, tip, profile = looked_at("cylinder", 0.08)
    origin, directions = rays(sensor, tip, CLEAN)
    a = np.sum(directions[:, :2] ** 2, axis=1)
    b = directions[:, :2] @ origin[:2]
    c = origin[:2] @ origin[:2] - 0.07**2
    inside = b**2 - a * c
    hit = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0.0))) / a, np.inf)
    expected = np.minimum(plane(origin, directions, 2, 0.0), hit)
    # Its facets are up to 2.7 um inside the circle.
    np.testing.assert_allclose(ranges(profile), expected, atol=1e-5)
    assert (expected == hit).sum() > 40


def test_box_is_a_box():
    sensor, tip, profile = looked_at("rectangular", 0.18)
    origin, directions = rays(sensor, tip, CLEAN)
    expected = np.minimum(plane(origin, directions, 2, 0.0), plane(origin, directions, 0, 0.060))
    np.testing.assert_allclose(ranges(profile), expected, atol=1e-8)


def test_points_lie_where_the_rays_end():
    sensor, tip, profile = looked_at("flat", 0.1)
    part = yaw_pose(0.42, -0.03, -0.05, 0.4)
    points = sensor.to_base(profile.across_m[0], profile.depth_m[0], part @ tip)
    in_part = (points - part[:3, 3]) @ part[:3, :3]
    np.testing.assert_allclose(np.minimum(abs(in_part[:, 1]), abs(in_part[:, 2])), 0.0, atol=1e-8)
    assert 5 < (abs(in_part[:, 2]) < 1e-8).sum() < CLEAN.points - 5
    in_tip = (in_part - tip[:3, 3]) @ tip[:3, :3]
    nearest = in_tip[np.argmin(np.linalg.norm(in_part[:, 1:], axis=1))]
    assert abs(nearest[1] - CLEAN.look_ahead_m) < 2e-3  # displaced by 4 mm along the nozzle, tilted by 24 deg


def test_rows_are_independent_and_follow_the_part():
    scene = scene_of("cylinder")
    sensor = DepthSensor(scene)
    tips = tip_poses(scene, np.array([0.02, 0.05, 0.09]))
    parts = np.stack([yaw_pose(0.4, 0.01 * k, -0.05, 0.1 * k) for k in range(3)])
    together = sensor.measure(parts @ tips, parts, [np.random.default_rng(k) for k in range(3)])
    for k in range(3):
        alone = sensor.measure((parts @ tips)[k : k + 1], parts[k : k + 1], [np.random.default_rng(k)])
        np.testing.assert_array_equal(alone.depth_m[0], together.depth_m[k])
    moved = yaw_pose(0.1, 0.2, 0.0, -1.0) @ parts
    again = sensor.measure(moved @ tips, moved, [np.random.default_rng(k) for k in range(3)])
    np.testing.assert_allclose(again.depth_m, together.depth_m, atol=1e-9)


def test_noise_and_dropout_are_as_configured():
    cfg = DepthCfg(sigma_m=8e-5, dropout=0.1)
    scene = scene_of("flat")
    part = scene.workpiece.pose
    tips = np.broadcast_to(part @ tip_poses(scene, np.array([0.1]))[0], (250, 4, 4))
    parts = np.broadcast_to(part, (250, 4, 4))
    rngs = [np.random.default_rng(k) for k in range(250)]
    clean = DepthSensor(scene, CLEAN).measure(tips[:1], parts[:1], rngs[:1])
    noisy = DepthSensor(scene, cfg).measure(tips, parts, [np.random.default_rng(k) for k in range(250)])
    error = np.hypot(noisy.across_m, noisy.depth_m) - np.hypot(*clean)[0]
    missing = np.isnan(error)
    count = missing.size
    assert abs(missing.mean() - 0.1) < 4 * np.sqrt(0.1 * 0.9 / count)
    error = error[~missing]
    assert abs(error.mean()) < 4 * 8e-5 / np.sqrt(len(error))
    assert abs(error.std() / 8e-5 - 1.0) < 4 / np.sqrt(2 * len(error))
    assert missing.any(axis=0).all()  # no point is safe, none always lost
    assert not missing.all(axis=0).any()


def test_grazing_and_distant_faces_give_no_echo():
    for cfg in (replace(CLEAN, max_incidence_rad=np.deg2rad(30.0)), replace(CLEAN, range_m=0.05)):
        _, _, profile = looked_at("flat", 0.1, cfg)
        assert np.isnan(profile.depth_m).all()


@pytest.mark.parametrize("look_ahead", [0.003, 0.015])
def test_the_gun_is_not_in_the_lights_way(look_ahead):
    scene = scene_of("flat")
    cfg = replace(CLEAN, look_ahead_m=look_ahead)
    reach = check_reach(scene, 0.0, 0.0, by_vision=False)
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = reach.start_q
    mujoco.mj_kinematics(model, data)
    tip = np.eye(4)
    tip[:3, 3] = data.site(GUN_PREFIX + "tip").xpos
    tip[:3, :3] = data.site(GUN_PREFIX + "tip").xmat.reshape(3, 3)
    origin, directions = rays(None, tip, cfg)
    gun = {g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name.startswith(GUN_PREFIX)}
    assert len(gun) > 10
    hit = np.zeros(1, np.int32)
    for direction in directions:
        mujoco.mj_ray(model, data, origin, direction, None, 1, -1, hit)
        assert int(hit[0]) not in gun


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": 7}, "points = 7"),
        ({"points": 20.5}, "points = 20.5"),
        ({"dropout": 1.5}, "dropout = 1.5"),
        ({"sigma_m": -1e-5}, "sigma_m"),
        ({"look_ahead_m": float("nan")}, "look_ahead_m = nan"),
        ({"origin_m": (0.0, 0.03, 0.0)}, "origin_m"),
    ],
)
def test_nonsense_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        DepthCfg(**change)
