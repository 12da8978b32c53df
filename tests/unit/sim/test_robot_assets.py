"""The UR5 and the sealing gun: against pinocchio, the makers' tables and the parts they have to clear."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from seal_gym.core import kinematics
from seal_gym.core.cell import load_cell
from seal_gym.core.frames import tip_rotation, transform
from seal_gym.core.paths import asset
from seal_gym.planning import ik
from seal_gym.sim.scene import build_scene
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.workpiece import Workpiece

N = 200
URDF = "share/example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"
T_BASE_URDF = np.diag([-1.0, -1.0, 1.0, 1.0])  # the URDF's base_link is turned by pi about z
LINKS = tuple(
    f"{name}_link" for name in ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
)
# Universal Robots' table for the UR5: mass [kg] and centre of mass in the link's DH frame [m].
MASS = (3.7, 8.393, 2.275, 1.219, 1.219, 0.1879)
CENTRE = (
    (0, -0.02561, 0.00193),
    (0.2125, 0, 0.11336),
    (0.15, 0, 0.0265),
    (0, -0.0018, 0.01634),
    (0, 0.0018, 0.01634),
    (0, 0, -0.001159),
)
# The solid cylinders that stand for the links' inertias: axis in the body frame, radius and length [m].
CYLINDER = (
    (1, 0.060, 0.130),
    (0, 0.055, 0.545),
    (0, 0.045, 0.489),
    (1, 0.0388, 0.105),
    (1, 0.0388, 0.105),
    (2, 0.0375, 0.035),
)
# Postures at the seams' starts, found by the prototype of the cell [deg].
START = {
    "flat": np.radians([-4, -117.8, -94.7, -102.4, 87.2, -92.8]),
    "cylinder": np.radians([-22.8, -111.4, -110.8, -68.9, 130.7, -30.7]),
    "rectangular": np.radians([-26, -106.8, -116.9, -70, 129.5, -34.6]),
}
GUN_GEOMS = ("holder", "valve", "cartridge", "nozzle", "camera_front", "camera_side")
MOUTH_RADIUS = 1.5e-3
CLEARANCE = (3e-3 - MOUTH_RADIUS) * np.sqrt(0.5)  # of the mouth's rim to wall and plate: 1.06 mm


def spec_of(name):
    return mujoco.MjSpec.from_file(str(asset("ur5_sealgun", f"{name}.xml")))


def arm_with_gun():
    spec = spec_of("ur5")
    spec.attach(spec_of("sealgun"), prefix="gun/", site=spec.site("tool0"))
    return spec.compile()


@pytest.fixture(scope="module")
def arm():
    return spec_of("ur5").compile()


@pytest.fixture(scope="module")
def armed():
    return arm_with_gun()


@pytest.fixture(scope="module")
def states():
    rng = np.random.default_rng(3)
    q = rng.uniform(kinematics.JOINT_LOWER, kinematics.JOINT_UPPER, (N, 6))
    return list(zip(q, rng.uniform(-1, 1, (N, 6)) * kinematics.JOINT_SPEED, strict=True))


@pytest.fixture(scope="module")
def pinocchio():
    return pytest.importorskip("pinocchio", reason="the reference UR5 needs pin and example-robot-data")


@pytest.fixture(scope="module")
def urdf_arm(pinocchio):
    return pinocchio.buildModelFromUrdf(str(Path(pinocchio.__file__).parents[4] / URDF))


def at(model, q, qd=0.0):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, qd
    mujoco.mj_forward(model, data)
    return data


def site_pose(data, name):
    site = data.site(name)
    return transform(site.xmat.reshape(3, 3), site.xpos)


def contacts(data):
    """Unordered pairs of the names of geoms that touch."""
    return {frozenset(data.model.geom(int(g)).name for g in c.geom) for c in data.contact}


# --- against pinocchio ---


def test_flange_jacobian_and_its_rate_equal_pinocchio(pinocchio, urdf_arm, arm, states):
    turn = np.kron(np.eye(2), T_BASE_URDF[:3, :3])
    flange, reference = urdf_arm.createData(), pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
    frame = urdf_arm.getFrameId("tool0")
    body = arm.body("wrist_3_link").id
    jacobian, rate = np.empty((2, 3, 6)), np.empty((2, 3, 6))
    for q, qd in states:
        data = at(arm, q, qd)
        point = data.site("tool0").xpos
        mujoco.mj_jac(arm, data, *jacobian, point, body)
        mujoco.mj_jacDot(arm, data, *rate, point, body)
        pinocchio.computeJointJacobiansTimeVariation(urdf_arm, flange, q, qd)
        pinocchio.updateFramePlacements(urdf_arm, flange)
        for ours, theirs in (
            (site_pose(data, "tool0"), T_BASE_URDF @ flange.oMf[frame].homogeneous),
            (jacobian.reshape(6, 6), turn @ pinocchio.getFrameJacobian(urdf_arm, flange, frame, reference)),
            (
                rate.reshape(6, 6),
                turn @ pinocchio.getFrameJacobianTimeVariation(urdf_arm, flange, frame, reference),
            ),
        ):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def body_inertia(pinocchio, model, body):
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    turn = turn.reshape(3, 3)
    moments = turn @ np.diag(model.body_inertia[body]) @ turn.T
    return pinocchio.Inertia(float(model.body_mass[body]), model.body_ipos[body].copy(), moments)


def with_inertias_of(pinocchio, urdf_arm, model):
    """The URDF's joints with the masses of a MuJoCo model: everything each joint carries rigidly."""
    other = pinocchio.Model(urdf_arm)
    home, zero = other.createData(), at(model, np.zeros(6))
    pinocchio.forwardKinematics(other, home, np.zeros(6))
    for joint in range(1, 7):
        other.inertias[joint] = pinocchio.Inertia.Zero()
    for body in range(1, model.nbody):
        joint = int(model.body_dofadr[model.body_weldid[body]]) + 1
        if joint < 1:
            continue  # the base does not move
        pose = transform(zero.xmat[body].reshape(3, 3), zero.xpos[body])
        carried = home.oMi[joint].inverse() * pinocchio.SE3(T_BASE_URDF @ pose)
        other.inertias[joint] += carried.act(body_inertia(pinocchio, model, body))
    other.armature = model.dof_armature.copy()
    return other


@pytest.mark.parametrize("gun", [False, True], ids=["arm", "arm and gun"])
def test_mass_matrix_and_bias_equal_pinocchio(pinocchio, urdf_arm, arm, armed, states, gun):
    model = armed if gun else arm
    other = with_inertias_of(pinocchio, urdf_arm, model)
    theirs = other.createData()
    mass = np.empty((6, 6))
    for q, qd in states:
        data = at(model, q, qd)
        mujoco.mj_fullM(model, data, mass)
        upper = np.triu(pinocchio.crba(other, theirs, q))
        np.testing.assert_allclose(mass, upper + np.triu(upper, 1).T, rtol=0, atol=1e-9)
        bias = pinocchio.nonLinearEffects(other, theirs, q, qd)
        np.testing.assert_allclose(data.qfrc_bias, bias, rtol=0, atol=1e-9)


def test_no_hidden_inertia_friction_or_springs(arm):
    for name in ("dof_armature", "dof_damping", "dof_frictionloss", "jnt_stiffness"):
        assert not getattr(arm, name).any(), name


def test_limits_equal_the_published_ones(arm, urdf_arm):
    assert [arm.joint(j).name for j in range(6)] == list(urdf_arm.names)[1:]
    assert arm.jnt_limited.all()
    assert arm.jnt_actfrclimited.all()
    assert arm.actuator_ctrllimited.all()
    assert arm.actuator_forcelimited.all()
    lower, upper = urdf_arm.lowerPositionLimit, urdf_arm.upperPositionLimit
    position, torque = np.column_stack((lower, upper)), urdf_arm.effortLimit
    np.testing.assert_allclose(arm.jnt_range, position, rtol=0, atol=1e-6)
    np.testing.assert_allclose(arm.actuator_ctrlrange, position, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(arm.jnt_actfrcrange, np.column_stack((-torque, torque)))
    np.testing.assert_array_equal(arm.actuator_forcerange, np.column_stack((-torque, torque)))
    np.testing.assert_array_equal(kinematics.JOINT_SPEED, urdf_arm.velocityLimit)


def test_limits_equal_the_kinematics_module(arm):
    # Without pinocchio as well: MuJoCo and our own trajectories stop at the same place.
    limits = np.column_stack((kinematics.JOINT_LOWER, kinematics.JOINT_UPPER))
    np.testing.assert_allclose(arm.jnt_range, limits, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(arm.jnt_actfrcrange[:, 1], kinematics.JOINT_TORQUE)
    np.testing.assert_array_equal(kinematics.JOINT_SPEED, [3.15, 3.15, 3.15, 3.2, 3.2, 3.2])


# --- against the makers' table ---


@pytest.mark.parametrize("k", range(6), ids=LINKS)
def test_link_mass_centre_and_inertia(arm, k):
    body = arm.body(LINKS[k])
    # From DH frame k+1, where the table stands, to the body's frame: Trans(a, 0, d) Rot_x(alpha).
    cos, sin = kinematics.DH_COS_ALPHA[k], kinematics.DH_SIN_ALPHA[k]
    turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    centre = turn @ CENTRE[k] + [kinematics.DH_A[k], 0, kinematics.DH_D[k]]
    np.testing.assert_allclose(body.mass, MASS[k])
    np.testing.assert_allclose(body.ipos, centre, rtol=0, atol=1e-9)
    axis, radius, length = CYLINDER[k]
    moments = np.full(3, MASS[k] * (3 * radius**2 + length**2) / 12)
    moments[axis] = MASS[k] * radius**2 / 2
    found = np.empty(9)
    mujoco.mju_quat2Mat(found, body.iquat)
    found = found.reshape(3, 3) @ np.diag(body.inertia) @ found.reshape(3, 3).T
    np.testing.assert_allclose(found, np.diag(moments), rtol=1e-5, atol=1e-12)


def test_gun_is_a_payload_the_arm_may_carry(arm, armed):
    gun = armed.body("gun/sealgun")
    assert gun.mass[0] == pytest.approx(2.0)
    assert armed.body_mass.sum() == pytest.approx(arm.body_mass.sum() + 2.0)
    assert gun.mass[0] < 5.0
    largest, *rest = sorted(gun.inertia, reverse=True)
    assert 0 < largest < sum(rest)
    # The centre of mass lies inside the holder.
    assert np.hypot(*gun.ipos[:2]) < 0.0375
    assert 0 < gun.ipos[2] < 0.132


@pytest.mark.parametrize("posture", START.values(), ids=START.keys())
def test_gravity_is_compensated_and_the_servos_hold(armed, posture):
    data = at(armed, posture)
    np.testing.assert_allclose(data.qfrc_gravcomp, data.qfrc_bias, rtol=0, atol=1e-9)
    assert np.abs(data.qfrc_bias).max() > 10.0
    data.ctrl[:] = posture
    for _ in range(120):
        mujoco.mj_step(armed, data)
    np.testing.assert_allclose(data.qpos, posture, rtol=0, atol=1e-6)


# --- the tip and the mouth ---


def test_tip_site_lies_where_the_kinematics_say(armed, states):
    expected = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.25], [0, 0, 0, 1]])
    np.testing.assert_array_equal(kinematics.T_TOOL0_TIP, expected)
    for q, _ in states:
        data = at(armed, q)
        flange, tip = site_pose(data, "tool0"), site_pose(data, "gun/tip")
        np.testing.assert_allclose(tip, flange @ expected, rtol=0, atol=1e-12)
        ours = kinematics.tip_kinematics(q[None], np.zeros((1, 6))).pose[0]
        np.testing.assert_allclose(tip, ours, rtol=0, atol=1e-9)


def nozzle_vertices(model):
    """Vertices of the nozzle that collides, in the tip frame, shape (n, 3), m."""
    data = at(model, START["flat"])
    geom = data.geom("gun/col_nozzle")
    mesh = model.mesh(int(model.geom_dataid[geom.id]))
    first = int(mesh.vertadr[0])
    vertices = model.mesh_vert[first : first + int(mesh.vertnum[0])].astype(float)
    world = vertices @ geom.xmat.reshape(3, 3).T + geom.xpos
    tip = site_pose(data, "gun/tip")
    return (world - tip[:3, 3]) @ tip[:3, :3]


def test_mouth_is_round_and_its_centre_is_the_tip(armed):
    vertices = nozzle_vertices(armed)
    assert vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    rim = vertices[vertices[:, 2] < 1e-6]
    outer = rim[np.hypot(*rim[:, :2].T) > 1e-6]  # the disc's centre may be a vertex
    assert len(outer) >= 16
    np.testing.assert_allclose(np.hypot(*outer[:, :2].T), MOUTH_RADIUS, rtol=0, atol=1e-6)
    np.testing.assert_allclose(outer[:, :2].mean(axis=0), 0.0, atol=1e-6)
    assert load_cell().process.mouth_radius_m == MOUTH_RADIUS


def test_the_nozzle_that_is_seen_is_the_one_that_collides(armed):
    collides = armed.geom("gun/col_nozzle")
    (seen,) = (
        g
        for g in range(armed.ngeom)
        if armed.geom_dataid[g] == collides.dataid[0] and armed.geom_contype[g] == 0
    )
    np.testing.assert_array_equal(armed.geom_pos[seen], collides.pos)
    np.testing.assert_array_equal(armed.geom_quat[seen], collides.quat)


def test_mouth_clears_wall_and_plate_by_1_06_mm(armed):
    vertices = nozzle_vertices(armed)
    approach = np.array([0.0, -np.sqrt(0.5), np.sqrt(0.5)])  # the plate is z = 0, the wall y = 0
    rotation = tip_rotation(np.array([1.0, 0.0, 0.0]), approach)
    placed = vertices @ rotation.T + 3e-3 * approach
    assert placed[:, 2].min() == pytest.approx(1.0607e-3, abs=2e-6)
    assert -placed[:, 1].max() == pytest.approx(1.0607e-3, abs=2e-6)


@pytest.mark.parametrize("view", ["front", "side"])
def test_camera_housing_stands_behind_its_optical_centre(armed, view):
    data, camera = at(armed, START["flat"]), getattr(load_cell(), view)
    housing, tip = data.geom(f"gun/col_camera_{view}"), site_pose(data, "gun/tip")
    axis = camera.rotation[:, 2]
    centre = (housing.xpos - tip[:3, 3]) @ tip[:3, :3]
    half = armed.geom(f"gun/col_camera_{view}").size[2]
    # The box is centred on the optical axis, square to it, and ends 0.7 mm behind the optical centre.
    np.testing.assert_allclose(centre, camera.position_m - (half + 0.7e-3) * axis, rtol=0, atol=2e-5)
    backward = tip[:3, :3].T @ housing.xmat.reshape(3, 3)[:, 2]
    np.testing.assert_allclose(backward, -axis, rtol=0, atol=1e-3)


@pytest.mark.parametrize("view", ["front", "side"])
def test_nothing_but_the_nozzle_stands_in_a_cameras_view(armed, view):
    data, camera = at(armed, START["flat"]), getattr(load_cell(), view)
    tip = site_pose(data, "gun/tip")
    eye = tip[:3, :3] @ camera.position_m + tip[:3, 3]
    seen, hit = set(), np.empty(1, np.int32)
    slopes = np.tan(np.radians(8.0)) * np.linspace(-1, 1, 41)
    for x, y in np.stack(np.meshgrid(slopes, slopes), axis=-1).reshape(-1, 2):
        ray = tip[:3, :3] @ camera.rotation @ np.array([x, y, 1.0])
        if mujoco.mj_ray(armed, data, eye, ray, None, 1, -1, hit) >= 0:
            seen.add(int(hit[0]))
    # The region of interest lies within 8 deg of the axis, and the nozzle is all there is between.
    nozzle = armed.geom("gun/col_nozzle").dataid[0]
    assert seen
    assert all(armed.geom_dataid[g] == nozzle for g in seen), seen


# --- contacts with itself ---


def test_start_postures_and_their_surroundings_are_free_of_self_contact(armed):
    rng = np.random.default_rng(15)
    for posture in START.values():
        around = posture + np.radians(15) * rng.uniform(-1, 1, (300, 6))
        for q in np.vstack((posture, around)):
            assert not contacts(at(armed, q)), np.degrees(q)


@pytest.mark.parametrize(
    ("elbow", "wrist", "pair"),
    [
        (170, -90, {"col_forearm", "col_shoulder"}),
        (170, 180, {"col_upper_arm", "col_wrist_1"}),
        (160, 0, {"col_upper_arm_shoulder", "col_wrist_3"}),
        (140, 90, {"col_upper_arm", "gun/col_nozzle"}),
        (140, 90, {"col_upper_arm", "gun/col_camera_side"}),
        (170, 0, {"col_base", "gun/col_holder"}),
    ],
)
def test_a_folded_arm_hits_itself(armed, elbow, wrist, pair):
    assert pair in contacts(at(armed, np.radians([0, -90, elbow, wrist, 90, 0])))


# --- the parts ---


def wall_part(height):
    """A straight seam like the catalogue's flat part, with a wall of another height."""
    return Workpiece.from_polyline(
        [[-0.10, 0, 0], [0.10, 0, 0]],
        [0.0, -np.sqrt(0.5), np.sqrt(0.5)],
        name=f"wall{height * 1e3:.0f}",
        wall_height=height,
        pose=(0.35, 0.0, -0.05, np.pi / 2),
    )


PARTS = {name: (catalogue.get, name) for name in catalogue.NAMES}
PARTS |= {f"wall of {h * 1e3:.0f} mm": (wall_part, h) for h in (0.025, 0.030, 0.035, 0.040)}


def tip_poses(part, step=5e-3):
    """Nominal poses along the seam in the base frame: leaning 45 deg, 3 mm off."""
    s = np.linspace(0.0, part.seam.length, int(part.seam.length / step) + 2)
    position, tangent, approach = part.seam.at(s)
    return part.pose @ transform(tip_rotation(tangent, approach), position + 3e-3 * approach)


def follow(poses, start):
    """Postures along the poses, each near the one before."""
    q = [start]
    for solutions in ik.solve(poses):
        q.append(ik.nearest(solutions, q[-1]))
    return np.array(q[1:])


def moved(pose, shift):
    """A pose displaced in the base frame."""
    out = pose.copy()
    out[:3, 3] += shift
    return out


@pytest.mark.parametrize("part", PARTS)
def test_arm_gun_and_cameras_clear_the_part(part):
    make, argument = PARTS[part]
    workpiece = make(argument)
    model = build_scene(workpiece, load_cell()).model
    poses = tip_poses(workpiece)
    postures = follow(poses, START.get(part, START["flat"]))
    assert np.isfinite(postures).all()
    assert np.abs(np.diff(postures, axis=0)).max() < 0.6
    for pose, q in zip(poses, postures, strict=True):
        data = at(model, q)
        np.testing.assert_allclose(site_pose(data, "gun/tip"), pose, rtol=0, atol=1e-9)
        assert data.ncon == 0, contacts(data)


@pytest.mark.parametrize("part", catalogue.NAMES)
def test_published_start_postures_put_the_nozzle_at_the_seams_start(part):
    pose = tip_poses(catalogue.get(part))[0]
    found = ik.nearest(ik.solve(pose), START[part])
    np.testing.assert_allclose(np.degrees(found), np.degrees(START[part]), rtol=0, atol=0.2)


@pytest.fixture(scope="module")
def flat():
    """The flat part's scene, the middle pose, and the directions into the plate and into the wall."""
    workpiece = catalogue.get("flat")
    scene = build_scene(workpiece, load_cell())
    poses = tip_poses(workpiece)
    directions = {"plate": np.array([0.0, 0.0, -1.0]), "wall": workpiece.pose[:3, 1]}
    return scene.model, poses[len(poses) // 2], directions


SOLID = {"plate": "col_part_0", "wall": "col_part_1"}


@pytest.mark.parametrize("solid", SOLID)
def test_the_mouth_touches_when_its_clearance_is_used_up(flat, solid):
    model, pose, directions = flat
    for shift, touches in ((CLEARANCE - 20e-6, False), (CLEARANCE + 20e-6, True), (2e-3, True)):
        shifted = moved(pose, shift * directions[solid])
        data = at(model, ik.nearest(ik.solve(shifted), START["flat"]))
        assert contacts(data) == ({frozenset((SOLID[solid], "gun/col_nozzle"))} if touches else set())


@pytest.mark.parametrize("solid", SOLID)
@pytest.mark.parametrize("geom", GUN_GEOMS)
def test_every_part_of_the_gun_can_hit_wall_and_plate(flat, geom, solid):
    model, pose, _ = flat
    data = at(model, ik.nearest(ik.solve(pose), START["flat"]))
    # The arm goes to where the geom's centre lies in the solid's.
    shift = data.geom(SOLID[solid]).xpos - data.geom(f"gun/col_{geom}").xpos
    q = ik.nearest(ik.solve(moved(pose, shift)), START["flat"])
    assert np.isfinite(q).all()
    assert {SOLID[solid], f"gun/col_{geom}"} in contacts(at(model, q))


ARM_GEOMS = tuple(
    f"col_{name}"
    for name in (
        *("shoulder_column", "shoulder", "upper_arm_shoulder", "upper_arm", "upper_arm_elbow"),
        *("forearm_elbow", "forearm", "forearm_wrist", "wrist_1", "wrist_2", "wrist_3"),
    )
)


@pytest.mark.parametrize("geom", ARM_GEOMS)
def test_every_link_can_be_hit(flat, geom):
    model, _, _ = flat
    data = at(model, START["flat"])
    # Here the part comes to the arm: the plate's centre to the geom's.
    data.mocap_pos[0] += data.geom(geom).xpos - data.geom("col_part_0").xpos
    mujoco.mj_forward(model, data)
    assert {"col_part_0", geom} in contacts(data)


@pytest.mark.parametrize(
    ("sink", "pair"),
    [
        (-4, {"gun/col_nozzle", "col_part_0"}),
        (-20, {"gun/col_camera_front", "table"}),
        (-40, {"col_wrist_1", "table"}),
        (-50, {"col_forearm", "col_part_0"}),
    ],
)
def test_a_sinking_arm_hits_plate_and_table(flat, sink, pair):
    model, _, _ = flat
    assert pair in contacts(at(model, START["flat"] + np.radians([0, sink, 0, 0, 0, 0])))


def test_all_collision_geoms_are_covered_above(armed):
    colliding = {armed.geom(g).name for g in range(armed.ngeom) if armed.geom_contype[g]}
    assert colliding == {"col_base", *ARM_GEOMS, *(f"gun/col_{name}" for name in GUN_GEOMS)}
    for g in range(armed.ngeom):
        if armed.geom_contype[g]:
            assert (armed.geom_contype[g], armed.geom_conaffinity[g], armed.geom_group[g]) == (1, 3, 3)
        else:
            assert (armed.geom_conaffinity[g], armed.geom_group[g]) == (0, 2)
