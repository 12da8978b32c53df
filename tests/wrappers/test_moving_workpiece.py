"""Moving parts: bounds and smoothness by finite differences, physics and errors by MuJoCo's own poses."""

import mujoco
import numpy as np
import pytest

from agents.expert import RmpExpert
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import yaw_pose
from seal_gym.sim.arm import ArmBatch, Outside, Poses
from seal_gym.sim.scene import cached_scene
from seal_gym.workpieces import catalogue
from seal_gym.wrappers.moving_workpiece import MOTIONS, PROFILES, MovingWorkpieceCfg, PartMotion

CELL = load_cell()
STEP_S = CELL.timing.step_s
POSE = yaw_pose(0.35, 0.02, -0.05, 1.2)


def motion(cfg, seed):
    out = PartMotion(1, cfg)
    out.reset(0, np.random.default_rng(seed), POSE)
    return out


def displacements(part, t):
    """x, y, z [mm] and yaw [deg] in the part's first frame, by MuJoCo's quaternions."""
    poses = part.poses(t[None])
    matrix = np.empty((len(t), 9))
    for row, quat in zip(matrix, poses.quat[0], strict=True):
        mujoco.mju_quat2Mat(row, quat)
    turn = POSE[:3, :3].T @ matrix.reshape(-1, 3, 3)
    np.testing.assert_allclose(turn[:, 2], np.tile([0, 0, 1.0], (len(t), 1)), atol=1e-12)
    shift = (poses.position[0] - POSE[:3, 3]) @ POSE[:3, :3]
    return 1e3 * shift, np.rad2deg(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))


@pytest.mark.parametrize("severity", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("profile", PROFILES)
def test_motion_keeps_within_its_bounds_and_comes_up_to_them(profile, severity):
    t = np.arange(0.0, 75.0, 1 / 60)
    largest = []
    for seed in range(12):
        part = motion(MovingWorkpieceCfg(severity=severity, profile=profile), seed)
        shift, yaw = displacements(part, t)
        speed = np.linalg.norm(np.diff(shift, axis=0), axis=1) * 60
        rate = np.abs(np.diff(yaw)) * 60
        assert np.abs(shift[:, 2]).max() < 1e-9
        shares = [
            np.array([np.linalg.norm(shift, axis=1).max() / 20, speed.max() / 10]) / severity,
            np.array([np.abs(yaw).max() / 10, rate.max() / 3]) / severity,
        ]
        assert max(map(np.max, shares)) <= 1.0 + 1e-6
        largest.append([s.max() for s in shares])
    assert np.min(largest) > 0.95


@pytest.mark.parametrize("seed", range(6))
def test_smooth_motion_has_no_jerks(seed):
    """Starts at rest; acceleration below Bernstein's bound for the highest harmonic, plus the onset's."""
    dt = 1 / 240
    t = np.arange(0.0, 70.0, dt)
    shift, yaw = displacements(motion(MovingWorkpieceCfg(), seed), t)
    omega = 2 * np.pi * 9 / 60
    for values, speed in ((shift, 10.0), (yaw[:, None], 3.0)):
        np.testing.assert_allclose(values[0], 0.0, atol=1e-9)
        velocity = np.diff(values, axis=0) / dt
        assert np.linalg.norm(velocity[0]) < 1e-3 * speed
        acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / dt
        # The onset's smoothstep is at its steepest 1.5 / s.
        assert acceleration.max() <= speed * (omega + 1.5) + 1e-3
        assert acceleration[t[2:] > 1.1].max() <= speed * omega + 1e-3


@pytest.mark.parametrize("profile", PROFILES)
def test_the_velocity_is_continuous(profile):
    """Halving the step halves the largest change of velocity in a step."""
    changes = []
    for dt in (1 / 240, 1 / 480):
        shift, _ = displacements(motion(MovingWorkpieceCfg(profile=profile), 3), np.arange(0.0, 30.0, dt))
        changes.append(np.linalg.norm(np.diff(shift, 2, axis=0), axis=1).max() / dt)
    assert changes[1] == pytest.approx(changes[0] / 2, rel=0.1)


def test_severity_scales_the_same_motion():
    t = np.linspace(0.0, 40.0, 50)
    half, twice = (displacements(motion(MovingWorkpieceCfg(severity=s), 5), t) for s in (0.5, 2.0))
    for a, b in zip(half, twice, strict=True):
        np.testing.assert_allclose(4 * a, b, atol=1e-9)


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("profile", PROFILES)
def test_translation_does_not_turn_and_rotation_does_not_shift(profile, kind):
    shift, yaw = displacements(
        motion(MovingWorkpieceCfg(profile=profile, motion=kind), 1), np.arange(0, 30, 0.1)
    )
    assert (np.abs(shift).max() > 1.0) == (kind != "rotation")
    assert (np.abs(yaw).max() > 1.0) == (kind != "translation")


@pytest.mark.parametrize("profile", PROFILES)
def test_matrices_and_twist_are_those_of_the_poses(profile):
    part, t, h = motion(MovingWorkpieceCfg(profile=profile), 2), np.arange(0.1, 20.0, 0.37), 1e-6
    for at in t:
        before, now, after = (part.matrices(np.array([at + d]))[0] for d in (-h, 0.0, h))
        shift, yaw = displacements(part, np.array([at]))
        moved = POSE @ yaw_pose(*(1e-3 * shift[0]), np.deg2rad(yaw[0]))
        np.testing.assert_allclose(now, moved, atol=1e-12)
        twist = part.twist(np.array([at]))[0]
        np.testing.assert_allclose(twist[:3], (after - before)[:3, 3] / (2 * h), atol=1e-7)
        spin = (after - before)[:3, :3] / (2 * h) @ now[:3, :3].T
        np.testing.assert_allclose(twist[3:], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-7)


def test_the_part_moves_within_the_physics_steps():
    """A hand-written loop over ``mj_step`` that moves the part in each: contacts and state to the bit."""
    scene, start = (
        cached_scene(catalogue.get("flat"), CELL),
        np.deg2rad([-4, -117.8, -94.7, -102.4, 87.2, -92.8]),
    )
    model, data = scene.model, mujoco.MjData(scene.model)
    arm, steps = ArmBatch(scene, 1), CELL.timing.substeps
    pose = scene.workpiece.pose
    arm.reset(0, start, pose)
    data.qpos[:] = start
    data.mocap_pos[0], data.mocap_quat[0] = arm.data(0).mocap_pos[0], arm.data(0).mocap_quat[0]
    velocity = np.array([0.010, 0.0, 0.008])  # the plate comes up to the nozzle
    touched = []
    for frame in range(20):
        t = (frame * steps + np.arange(steps + 1)) * STEP_S
        position = pose[:3, 3] + t[:, None] * velocity
        end = pose.copy()
        end[:3, 3] = position[-1]
        quat = np.tile(data.mocap_quat[0], (steps + 1, 1))
        outside = Outside(part=Poses(position[None], quat[None]), part_pose=end[None])
        touched.append(bool(arm.step(np.zeros((1, 6)), outside)[0]))
        contacts = 0
        for k in range(steps):
            data.mocap_pos[0] = position[k]
            data.ctrl[:] = start
            mujoco.mj_step(model, data)
            contacts += data.ncon
        assert touched[-1] == (contacts > 0)
        np.testing.assert_allclose(arm.q[0], data.qpos, atol=1e-12)
        np.testing.assert_array_equal(arm.data(0).body("part").xpos, position[-1])
        if touched[-1]:
            break
    assert touched[-1] and not touched[0]


def nearest_mm(core):
    """Distance from the nozzle mouth to the desired path on the part as MuJoCo has them now."""
    data, seam = core.arm.data(0), core.scene.workpiece.seam
    part = data.body("part")
    points = seam.at(np.linspace(-0.02, seam.length + 0.02, 8000))
    path = (points.position + 0.003 * points.approach) @ part.xmat.reshape(3, 3).T + part.xpos
    return 1e3 * np.linalg.norm(path - data.site("gun/tip").xpos, axis=1).min()


@pytest.mark.parametrize("env_id", ["SealGym/Flat-v0", "SealGym/Rectangular-v0"])
def test_the_error_of_a_still_gun_is_the_parts_displacement(make, env_id):
    env = make(env_id, disturbances=[{"name": "MovingWorkpiece", "severity": 1.0}])
    core = env.unwrapped.core
    _, info = env.reset(seed=11)
    tip, first = core.arm.data(0).site("gun/tip").xpos.copy(), info["tip_error_mm"]
    change = 0.0
    for _ in range(90):
        _, _, terminated, _, info = env.step(np.zeros(6, np.float32))
        assert info["tip_error_mm"] == pytest.approx(nearest_mm(core), abs=2e-3)
        change = max(change, abs(info["tip_error_mm"] - first))
        if terminated:
            break
    np.testing.assert_allclose(core.arm.data(0).site("gun/tip").xpos, tip, atol=2e-6)
    assert change > 1.0


def test_the_features_are_those_of_the_part_where_it_is_now(make):
    """The front view's distance grows by the part's displacement along the tip's x axis."""
    env = make(disturbances=[{"name": "MovingWorkpiece", "motion": "translation"}])
    core = env.unwrapped.core
    _, info = env.reset(seed=4)
    d, pose, origin = info["roi"]["d_front_mm"], core.tip.pose[0], core.arm.data(0).body("part").xpos.copy()
    tangent = core.arm.part_pose[0, :3, 0]
    across = np.cross(tangent, [0, 0, 1.0])
    for _ in range(60):
        _, _, terminated, _, info = env.step(np.zeros(6, np.float32))
        moved = (core.arm.data(0).body("part").xpos - origin) @ across * across
        # The line's point at y = 0 of the tip frame: a displacement along the seam is none.
        seam = pose[:3, :3].T @ tangent
        local = pose[:3, :3].T @ moved
        expected = 1e3 * (local - local[1] / seam[1] * seam)[0]
        assert info["roi"]["d_front_mm"] - d == pytest.approx(expected, abs=1e-3)
        if terminated or not info["roi"]["valid_front"]:
            break
    assert abs(expected) > 0.25


@pytest.mark.parametrize("env_id", ["SealGym/Flat-v0", "SealGym/Cylinder-v0"])
def test_the_oracles_seam_velocity_is_the_parts(make, env_id):
    """Across the seam, against the true twist at the tip's foot on it; the estimate is about a frame late."""
    env = make(env_id, control="rmp", disturbances=[{"name": "MovingWorkpiece", "severity": 2.0}])
    core, policy = env.unwrapped.core, RmpExpert(CELL)
    observation, info = env.reset(seed=21)
    errors, sizes = [], []
    seam = core.scene.workpiece.seam
    for k in range(330):
        action, _ = policy.predict(observation)
        observation, _, terminated, _, info = env.step(action)
        assert not terminated
        if k < 75:
            continue
        twist, part, rotation = core.part_twist[0], core.arm.part_pose[0], core.tip.pose[0, :3, :3]
        at = seam.at(core.progress.s[0])
        foot, along = part[:3, :3] @ at.position, part[:3, :3] @ at.tangent
        velocity = twist[:3] + np.cross(twist[3:], foot)
        velocity -= velocity @ along * along
        true = np.concatenate((rotation.T @ velocity, rotation.T @ twist[3:]))[[0, 2]]
        errors.append(info["seam_velocity"][[0, 2]] - true)
        sizes.append(true)
    rms = 1e3 * np.sqrt(np.mean(np.square(errors), axis=0))
    size = 1e3 * np.sqrt(np.mean(np.square(sizes), axis=0))
    assert rms.max() < 0.25 and size.max() > 2.0, (rms, size)


def test_the_metrics_know_the_seams_own_speed_and_the_observation_does_not(make):
    """Root mean square by finite differences of the seam's point under a gun that stands still."""
    env = make(disturbances=[{"name": "MovingWorkpiece", "motion": "translation", "profile": "sinusoidal"}])
    core = env.unwrapped.core
    env.reset(seed=3)
    places = [core.arm.data(0).body("part").xpos.copy()]
    for _ in range(40):
        env.step(np.zeros(6, np.float32))
        places.append(core.arm.data(0).body("part").xpos.copy())
    speed = 1e3 * np.linalg.norm(np.diff(places, axis=0), axis=1) * 30
    measured = core.progress.metrics(0)["seam_speed_mm_s"]
    assert measured == pytest.approx(np.sqrt(np.mean(speed**2)), rel=0.03)
    still = make()
    still.reset(seed=3)
    still.step(np.zeros(6, np.float32))
    assert "seam_speed_mm_s" not in still.unwrapped.core.progress.metrics(0)
    assert still.observation_space == env.observation_space


@pytest.mark.parametrize(
    "wrong",
    [
        {"severity": -1.0}, {"severity": float("nan")}, {"severity": True}, {"motion": "up"},
        {"profile": "square"}, {"amplitude_mm": 0.0}, {"speed_mm_s": 1e9}, {"ramp_s": 0.0},
    ],
)  # fmt: skip
def test_values_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        MovingWorkpieceCfg(**wrong)
