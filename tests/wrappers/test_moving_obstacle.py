"""The obstacle: where it goes, that it is felt, and that the cameras see it where the geometry says."""

from dataclasses import replace

import numpy as np
import pytest

import seal_gym
from agents.expert import RmpExpert
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.sim import gl
from seal_gym.sim.look import Look, LookCfg
from seal_gym.sim.raycast import Raycaster
from seal_gym.sim.scene import cached_scene
from seal_gym.workpieces import catalogue
from seal_gym.wrappers.moving_obstacle import Fist, MovingObstacleCfg

CELL = load_cell()
ONE = [{"name": "MovingObstacle", "severity": 1.0}]


def fist(name="flat", seed=0, **kwargs):
    scene = cached_scene(catalogue.get(name), CELL, 0.045)
    out = Fist(1, MovingObstacleCfg(**kwargs), scene)
    out.reset(0, np.random.default_rng(seed), scene.workpiece.pose)
    return out, scene


@pytest.mark.parametrize("name", catalogue.NAMES)
def test_it_waits_crosses_the_seam_above_the_wall_stays_and_withdraws(name):
    for seed in range(6):
        ball, scene = fist(name, seed)
        pose, seam = scene.workpiece.pose, scene.workpiece.seam
        dt = 1 / 240
        t = np.arange(0.0, 20.0, dt)
        still, _ = ball.at(t[None, :50])
        assert np.ptp(still[0], axis=0).max() == 0.0
        ball.watch(np.array([0.0]), np.array([0.0]))
        assert np.ptp(ball.at(t[None])[0][0], axis=0).max() == 0.0  # the gun is far yet
        ball.watch(np.array([seam.length]), np.array([2.0]))
        ball.watch(np.array([seam.length]), np.array([9.0]))  # sets out but once
        position, velocity = (x[0] for x in ball.at(t[None]))
        local = (position - pose[:3, 3]) @ pose[:3, :3]
        np.testing.assert_allclose(np.diff(position, axis=0) / dt, velocity[:-1], atol=3e-3)
        assert np.linalg.norm(velocity, axis=1).max() == pytest.approx(0.15, rel=1e-6)
        top = scene.workpiece.surface.triangles[..., 2].max()
        level = np.linalg.norm(local[:, :2] - local[0, :2], axis=1)
        np.testing.assert_allclose(local[0, 2] - local[:, 2], level, atol=1e-12)  # down at 45 degrees
        assert local[:, 2].min() - 0.045 >= top + 0.004
        # At rest: before, for 3 s + 3 s between the ramps at the far end, and after it is back.
        far = np.linalg.norm(local - local[0], axis=1)
        assert far.max() == pytest.approx(0.25, abs=1e-9)
        staying = np.sum(far > 0.25 - 1e-9) * dt
        assert staying == pytest.approx(3.0 + 3.0, abs=0.05)
        np.testing.assert_allclose(local[-1], local[0], atol=1e-12)


def test_severity_is_the_time_it_stays():
    for severity in (0.5, 2.0):
        ball, _ = fist(severity=severity)
        ball.watch(np.array([1.0]), np.array([0.0]))
        t = np.arange(0.0, 20.0, 1 / 240)
        far = np.linalg.norm(ball.at(t[None])[0][0] - ball.at(np.zeros((1, 1)))[0][0], axis=1)
        assert np.sum(far > 0.25 - 1e-9) / 240 == pytest.approx(3.0 + 3.0 * severity, abs=0.05)


@pytest.mark.parametrize("env_id", seal_gym.ENV_IDS[:3])
def test_who_drives_on_touches_it(make, env_id):
    """With the gun's front, in a place where the bare environment ends well."""
    env = make(env_id, control="rmp", disturbances=ONE)
    core, policy = env.unwrapped.core, RmpExpert(CELL)
    observation, info = env.reset(seed=500_000)
    np.testing.assert_array_equal(info["obstacle"]["position_m"], core.arm.data(0).body("obstacle").xpos)
    assert core.arm.data(0).ncon == 0
    done = False
    while not done:
        action, _ = policy.predict(observation)
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        body = core.arm.data(0).body("obstacle").xpos
        np.testing.assert_allclose(info["obstacle"]["position_m"], body, atol=1e-12)
        assert info["obstacle"]["radius_m"] == pytest.approx(0.045)
    assert info["episode_metrics"]["outcome"] == "collision"
    touching = {name for pair in core.arm.contacts(0) for name in pair}
    assert "obstacle" in touching and any(n.startswith("gun/") for n in touching)
    assert 0.2 < info["progress"] < 0.75


def test_who_waits_does_not(make):
    """A gun that stops short of the crossing until the obstacle has gone seals the seam."""
    env = make(control="rmp", disturbances=ONE)
    crawling = replace(CELL, process=replace(CELL.process, speed_m_s=1e-4))
    driver, waiter = RmpExpert(CELL), RmpExpert(crawling)
    observation, info = env.reset(seed=500_000)
    rest, done, waited = info["obstacle"]["position_m"], False, 0
    while not done:
        away = np.linalg.norm(info["obstacle"]["position_m"] - rest) > 0.05
        action, _ = (waiter if away else driver).predict(observation)
        waited += away
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    assert info["episode_metrics"]["outcome"] == "reached", env.unwrapped.core.arm.contacts(0)
    assert waited > 100


# -- seen ---------------------------------------------------------------------------------------------------


def ball_in_view(view, depth, radius, off_px):
    """A clean look with a ball at a pixel and depth of a camera, for a tip at the origin."""
    camera = CELL.cameras[view]
    look = Look.empty(1)
    look.draw(0, np.random.default_rng(0), LookCfg(**{**LookCfg.clean().__dict__, "clip_fraction": 1.0}))
    middle = np.array([camera.width, camera.height]) / 2 + off_px
    ray = np.append((middle - camera.centre_px) / camera.focal_px, 1.0)
    look.ball[0, :3] = camera.rotation @ (depth * ray) + camera.position_m
    look.ball[0, 3] = radius
    return look, camera


@pytest.mark.parametrize("view", [0, 1])
def test_the_balls_outline_is_its_cone_of_rays(view):
    """A pixel shows the ball where its ray passes the centre within the radius."""
    from seal_gym.core.frames import transform
    from seal_gym.workpieces.surface import PLATE, Surface

    camera = CELL.cameras[view]
    corners = np.array([[-1.0, -1.0, 0.1], [1.0, -1.0, 0.1], [0.0, 1.0, 0.1]])
    corners = corners if np.linalg.det(corners) < 0 else corners[::-1]
    caster = Raycaster(
        Surface(triangles=corners[None], material=np.array([PLATE], np.int32)), CELL, np.empty((0, 3, 3))
    )
    part = transform(camera.rotation, camera.position_m)[None]
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    for depth, radius, off in ((0.06, 1.2e-3, (3.3, -2.1)), (0.08, 3e-3, (-5.0, 4.0))):
        look, _ = ball_in_view(view, depth, radius, np.array(off))

        def picture(shown, look=look):
            look.ball[0, 3] = shown
            images = caster.render(np.eye(4)[None], part, look, np.zeros(1, np.uint64))
            return (images.front, images.side)[view][0].astype(float)

        changed = np.abs(picture(radius) - picture(0.0)).max(axis=-1) > 0
        rays = np.stack(
            ((u - camera.centre_px[0]) / camera.focal_px, (v - camera.centre_px[1]) / camera.focal_px), -1
        )
        rays = np.concatenate((rays, np.ones((*u.shape, 1))), axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        look.ball[0, 3] = radius
        centre = camera.rotation.T @ (look.ball[0, :3] - camera.position_m)
        miss = np.linalg.norm(np.cross(rays, centre), axis=-1)
        pixel = depth / camera.focal_px
        assert changed[miss < radius - pixel].mean() > 0.99  # a ball may happen to be as grey as the plate
        assert not changed[miss > radius + pixel].any()
        assert (miss < radius - pixel).sum() > 100


def test_the_part_hides_a_ball_behind_it():
    scene = cached_scene(catalogue.get("flat"), CELL, 0.045)
    caster = Raycaster(scene.workpiece.surface, CELL, scene.tool)
    seam = scene.workpiece.seam.at(0.1)
    from seal_gym.core.frames import tip_rotation, transform

    tip = transform(tip_rotation(seam.tangent, seam.approach), seam.position + 0.003 * seam.approach)
    look = Look.empty(1)
    look.draw(0, np.random.default_rng(0), LookCfg())
    images = []
    for place, radius in ((None, 0.0), (seam.position - 0.05 * seam.approach, 0.02), (seam.position, 0.02)):
        if place is not None:
            look.ball[0, :3] = place
        look.ball[0, 3] = radius
        images.append(caster.render(tip[None], np.eye(4)[None], look, np.zeros(1, np.uint64)).front)
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).mean() > 0.2


def test_the_sensor_cameras_see_the_obstacle_of_the_simulation(make):
    """Put in front of the seam by hand: the fist's own way ends above the cameras."""
    env = make(observation="features+images", disturbances=ONE)
    core = env.unwrapped.core
    clear = env.reset(seed=0)[0]["front"]
    ahead = core.tip.pose[0] @ np.array([0.0, 0.012, 0.05, 1.0])
    core._disturbances._fist._start[0] = ahead[:3]
    hidden = core.images
    assert (hidden.front[0] != clear).mean() > 0.9
    assert np.ptp(hidden.front[0].astype(float).mean(axis=-1)) < np.ptp(clear.astype(float).mean(axis=-1))


@pytest.mark.gl
def test_gl_draws_the_same_outline():
    scene = cached_scene(catalogue.get("flat"), CELL, 0.006)
    seam = scene.workpiece.seam.at(0.1)
    from seal_gym.core.frames import tip_rotation, transform

    part = scene.workpiece.pose
    tip = part @ transform(tip_rotation(seam.tangent, seam.approach), seam.position + 0.003 * seam.approach)
    look = Look.empty(1)
    look.draw(0, np.random.default_rng(0), LookCfg.clean())
    masks = []
    for renderer in (gl.GlSensors(scene), Raycaster(scene.workpiece.surface, CELL, scene.tool)):
        shots = []
        for height in (-1.0, 0.030):
            look.ball[0, :3] = tip[:3, 3] + tip[:3, :3] @ np.array([0.002, 0.014, height])
            look.ball[0, 3] = 0.006
            image = renderer.render(tip[None], part[None], look, np.zeros(1, np.uint64))
            shots.append(image.front[0].astype(float).mean(axis=-1))
        masks.append(np.abs(shots[1] - shots[0]) > 8)
    both, one = (masks[0] & masks[1]).sum(), (masks[0] | masks[1]).sum()
    assert one > 300 and both / one > 0.9


@pytest.mark.parametrize("wrong", [{"radius_mm": 1.0}, {"speed_mm_s": 0.0}, {"stay_s": -1.0}])
def test_values_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        MovingObstacleCfg(**wrong)
