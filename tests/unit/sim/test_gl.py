"""MuJoCo's renderer against the raycaster and against the pinhole formula."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import seal_gym  # noqa: F401  # registers the ids
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import RenderError
from seal_gym.core.frames import axis_angle, tip_rotation, transform
from seal_gym.core.kinematics import T_TOOL0_TIP
from seal_gym.sim import gl
from seal_gym.sim.look import Look, LookCfg
from seal_gym.sim.raycast import Raycaster
from seal_gym.sim.scene import GUN_PREFIX, cached_scene
from seal_gym.workpieces import catalogue

CELL = load_cell()
FRAME = np.zeros(1, np.uint64)


def poses(name, s, seed):
    """A tip near the desired pose at arc length s, and the part's pose, N = 1 each."""
    part = catalogue.get(name)
    rng = np.random.default_rng(seed)
    p, t, a = part.seam.at(s)
    tip = transform(tip_rotation(t, a), p + CELL.process.stand_off_m * a)
    turn = axis_angle(np.eye(3)[2], rng.uniform(-0.05, 0.05)) @ axis_angle(
        np.eye(3)[0], rng.uniform(-0.05, 0.05)
    )
    tip = tip @ transform(turn, rng.uniform(-1e-3, 1e-3, 3))
    return part.pose[None], (part.pose @ tip)[None]


def clean_look():
    look = Look.empty(1)
    look.draw(0, np.random.default_rng(0), LookCfg.clean())
    return look


def crossings(profiles):
    """Where each profile passes half way from its first to its last level [px]."""
    out = []
    for profile in profiles:
        low, high = profile[:3].mean(), profile[-3:].mean()
        level = (profile - low) / (high - low)
        k = int(np.argmax(level > 0.5))
        out.append(k - 0.5 + (0.5 - level[k - 1]) / (level[k] - level[k - 1]) + 0.5)
    return np.array(out)


@pytest.mark.gl
@pytest.mark.parametrize("name", catalogue.NAMES)
@pytest.mark.parametrize("seed", range(3))
def test_both_renderers_put_the_seam_in_the_same_place(name, seed):
    part_pose, tip_pose = poses(name, 0.05, seed)
    scene = cached_scene(catalogue.get(name), CELL)
    look = clean_look()
    images = [
        renderer.render(tip_pose, part_pose, look, FRAME)
        for renderer in (gl.GlSensors(scene), Raycaster(scene.workpiece.surface, CELL, scene.tool))
    ]
    # Rows ahead of the nozzle in the front view, columns ahead of it in the side view.
    front = [crossings(i.front[0, 20:65].mean(axis=-1)) for i in images]
    side = [crossings(i.side[0, :, 35:80].mean(axis=-1).T) for i in images]
    assert abs(np.mean(front[0] - front[1])) < 0.1
    assert abs(np.mean(side[0] - side[1])) < 0.1
    assert np.max(np.abs(front[0] - front[1])) < 0.3  # one row: both quantise to 8 bits
    assert np.max(np.abs(side[0] - side[1])) < 0.3


@pytest.mark.gl
@pytest.mark.parametrize("camera", CELL.cameras, ids=lambda c: c.name)
def test_the_projection_is_the_analytic_one(camera):
    scene = cached_scene(catalogue.get("flat"), CELL)
    source = scene.model.camera(camera.name)
    zoom, radius = 16, 4e-4
    rng = np.random.default_rng(1)
    points = np.column_stack((rng.uniform(-3e-3, 3e-3, 6), rng.uniform(-2e-3, 1.5e-2, 6), np.full(6, -3e-3)))
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = zoom * camera.width, zoom * camera.height
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0] * 3, [0] * 3
    spec.visual.map.znear = 0.001
    spec.stat.extent = 1.0
    spec.add_material(name="lit", emission=1.0, rgba=[1, 1, 1, 1])
    body = spec.worldbody.add_body(name="point")
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], material="lit", mass=1)
    # The scene's own camera parameters, with the tip's frame as the world.
    tip_from_gun = np.linalg.inv(T_TOOL0_TIP)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, source.quat)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, (tip_from_gun[:3, :3] @ rotation.reshape(3, 3)).ravel())
    spec.worldbody.add_camera(
        name="eye",
        pos=tip_from_gun[:3, :3] @ source.pos + tip_from_gun[:3, 3],
        quat=quat,
        resolution=list(scene.model.cam_resolution[source.id]),
        focal_length=list(scene.model.cam_intrinsic[source.id, :2]),
        principal_length=list(scene.model.cam_intrinsic[source.id, 2:]),
        sensor_size=list(scene.model.cam_sensorsize[source.id]),
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    with gl.offscreen(model, zoom * camera.height, zoom * camera.width) as renderer:
        for point in points:
            data.qpos[:3] = point
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, camera="eye")
            weight = renderer.render()[..., 0].astype(float)
            assert weight.sum() > 0
            rows, columns = np.mgrid[: weight.shape[0], : weight.shape[1]] + 0.5
            seen = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum() / zoom
            assert np.abs(seen - camera.project(point)).max() < 0.01


def test_the_gun_body_has_both_sensor_cameras():
    model = cached_scene(catalogue.get("flat"), CELL).model
    gun = model.body(GUN_PREFIX + "sealgun").id
    for camera in CELL.cameras:
        assert int(model.camera(camera.name).bodyid[0]) == gun


def test_without_opengl_the_error_says_what_to_do(monkeypatch):
    def broken(*_):
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setattr(mujoco, "Renderer", broken)
    with pytest.raises(RenderError, match="libegl1 libgl1 libgl1-mesa-dri"):
        gl.offscreen(None, 8, 8)


@pytest.mark.gl
def test_the_environment_takes_either_renderer():
    images = {}
    for renderer in ("raycast", "gl"):
        env = gym.make(
            "SealGym/Rectangular-v0",
            perception="oracle",
            observation="features+images",
            renderer=renderer,
            look=LookCfg.clean(),
            disable_env_checker=True,
        )
        observation, info = env.reset(seed=5)
        assert info["renderer"] == renderer
        images[renderer] = observation
    np.testing.assert_array_equal(images["gl"]["features"], images["raycast"]["features"])
    for view in ("front", "side"):
        a, b = (images[r][view].astype(float).ravel() for r in images)
        assert np.corrcoef(a, b)[0, 1] > 0.9
