"""The cell as a MuJoCo model: pedestal, UR5, gun, sensor cameras and a workpiece, composed with MjSpec."""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from seal_gym.core.cell import OVERHEAD, CellCfg
from seal_gym.core.errors import PhysicsError
from seal_gym.core.frames import Array, quat_from_matrix
from seal_gym.core.kinematics import T_TOOL0_TIP
from seal_gym.core.paths import asset
from seal_gym.sim import texture
from seal_gym.workpieces.solids import Solid
from seal_gym.workpieces.surface import MATERIALS
from seal_gym.workpieces.workpiece import PLATE_THICKNESS_M, Workpiece

if TYPE_CHECKING:
    from seal_gym.vision.part_pose import PartMarker

# Geom groups: what MuJoCo's viewer and our renderers switch on and off together.
GROUP_FURNITURE, GROUP_PART, GROUP_ROBOT, GROUP_COLLISION = 0, 1, 2, 3
# Robot geoms have contype 1 and conaffinity 3 (assets/ur5_sealgun): they hit each other and these.
ENVIRONMENT = {"contype": 2, "conaffinity": 1}
VISUAL = {"contype": 0, "conaffinity": 0}
GUN_PREFIX = "gun/"
PART_PREFIX = "col_part_"
OBSTACLE = "obstacle"
SKIN_RGB = (0.86, 0.66, 0.55)
TABLE_TOP_M = -0.05 - PLATE_THICKNESS_M
_FLOOR_M = -0.80

_G = mujoco.mjtGeom


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A compiled scene.

    Attributes:
        model: The MuJoCo model.
        workpiece: The part in it.
        cell: The cell it was built for.
        tool: Triangles of the nozzle in the tip frame, shape (m, 3, 3), m: the gun as its cameras see it.
        marker: The AR code on the part, if there is one.
    """

    model: mujoco.MjModel
    workpiece: Workpiece
    cell: CellCfg
    tool: Array
    marker: "PartMarker | None" = None


def add_furniture(spec: mujoco.MjSpec) -> None:
    """Adds floor, table, pedestal, lamps and the camera ``scene`` to a cell.

    Args:
        spec: The cell, with the arm.
    """
    spec.add_material(name="steel", rgba=[0.55, 0.56, 0.58, 1], specular=0.3)
    spec.add_material(name="bench", rgba=[0.46, 0.41, 0.36, 1], specular=0.1)
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.30, 0.32, 0.34],
        rgb2=[0.25, 0.27, 0.29],
        width=256,
        height=256,
    )
    floor = spec.add_material(name="floor", texrepeat=[2, 2], texuniform=True)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.80, 0.84, 0.88],
        rgb2=[0.55, 0.60, 0.66],
        width=64,
        height=384,
    )
    world = spec.worldbody
    world.add_geom(
        name="floor",
        type=_G.mjGEOM_PLANE,
        pos=[0, 0, _FLOOR_M],
        size=[3, 3, 0.1],
        material="floor",
        group=GROUP_FURNITURE,
        **VISUAL,
    )
    thickness = 0.04
    world.add_geom(
        name="table",
        type=_G.mjGEOM_BOX,
        pos=[0.32, 0, TABLE_TOP_M - thickness / 2],
        size=[0.52, 0.50, thickness / 2],
        material="bench",
        group=GROUP_FURNITURE,
        **ENVIRONMENT,
    )
    leg = (TABLE_TOP_M - thickness - _FLOOR_M) / 2
    for x in (-0.14, 0.78):
        for y in (-0.44, 0.44):
            world.add_geom(
                type=_G.mjGEOM_BOX,
                pos=[x, y, _FLOOR_M + leg],
                size=[0.03, 0.03, leg],
                material="steel",
                group=GROUP_FURNITURE,
                **VISUAL,
            )
    height = -TABLE_TOP_M / 2
    world.add_geom(
        name="pedestal",
        type=_G.mjGEOM_CYLINDER,
        pos=[0, 0, TABLE_TOP_M + height],
        size=[0.095, height, 0],
        material="steel",
        group=GROUP_FURNITURE,
        **ENVIRONMENT,
    )
    for k, (position, strength) in enumerate((((0.9, -0.7, 1.6), 0.55), ((-0.3, 0.9, 1.8), 0.35))):
        light = world.add_light(name=f"lamp{k}", pos=position, dir=np.subtract((0.35, 0, 0), position))
        light.diffuse, light.specular = [strength] * 3, [0.15] * 3
        light.castshadow = k == 0
    spec.visual.headlight.ambient = [0.32] * 3
    spec.visual.headlight.diffuse = [0.25] * 3
    spec.visual.headlight.specular = [0.0] * 3
    spec.visual.quality.shadowsize = 2048
    spec.visual.map.znear = 0.01
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.stat.extent, spec.stat.center = 1.0, [0.3, 0.0, 0.1]
    eye, target = np.array([1.05, -0.62, 0.62]), np.array([0.30, 0.0, 0.10])
    world.add_camera(name="scene", pos=eye, quat=_look_at(eye, target), fovy=42)


def _look_at(eye: Array, target: Array) -> Array:
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return quat_from_matrix(np.column_stack((right, np.cross(back, right), back)))


def _add_sensor_cameras(body: mujoco.MjsBody, cell: CellCfg) -> None:
    for camera in cell.cameras:
        width, height = camera.width, camera.height
        # MuJoCo's camera looks along -z with y up; its principal point counts from the ROI's centre.
        rotation = T_TOOL0_TIP[:3, :3] @ camera.rotation @ np.diag([1.0, -1.0, -1.0])
        offset = np.array([width / 2, height / 2]) - camera.centre_px
        element = body.add_camera(
            name=camera.name,
            pos=T_TOOL0_TIP[:3, :3] @ camera.position_m + T_TOOL0_TIP[:3, 3],
            quat=quat_from_matrix(rotation),
            resolution=[width, height],
            focal_pixel=[camera.focal_px] * 2,
            principal_pixel=offset,
        )
        element.sensor_size = np.array([width, height]) * 1e-5


def _add_solid(body: mujoco.MjsBody, spec: mujoco.MjSpec, k: int, solid: Solid) -> None:
    common = {
        "name": f"{PART_PREFIX}{k}",
        "pos": solid.pose[:3, 3],
        "quat": quat_from_matrix(solid.pose[:3, :3]),
        "group": GROUP_COLLISION,
        "rgba": [0.9, 0.4, 0.2, 0.4],
        **ENVIRONMENT,
    }
    if solid.kind == "box":
        body.add_geom(type=_G.mjGEOM_BOX, size=solid.size, **common)
    elif solid.kind == "cylinder":
        body.add_geom(type=_G.mjGEOM_CYLINDER, size=solid.size, **common)
    else:
        # By its surface: thin pieces have hardly a volume (and a mocap body needs no inertia).
        mesh = spec.add_mesh(name=f"solid_{k}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        mesh.uservert = solid.points.astype(np.float32).ravel()
        body.add_geom(type=_G.mjGEOM_MESH, meshname=f"solid_{k}", **common)


def _add_part(spec: mujoco.MjSpec, workpiece: Workpiece) -> None:
    pose = workpiece.pose
    part = spec.worldbody.add_body(
        name="part", mocap=True, pos=pose[:3, 3], quat=quat_from_matrix(pose[:3, :3])
    )
    surface = workpiece.surface
    uv = surface.uv_m / texture.PERIOD_M
    for index, material in enumerate(MATERIALS):
        chosen = surface.material == index
        if not chosen.any():
            continue
        grain = spec.add_texture(
            name=f"grain_{material.name}",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=texture.SIZE,
            height=texture.SIZE,
            nchannel=3,
        )
        grain.data = texture.albedo_map(material.texture).tobytes()
        rgb = [(1.0 + material.texture) * c for c in material.rgb]
        look = spec.add_material(name=material.name, rgba=[*rgb, 1.0], specular=0.1, shininess=0.1)
        look.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = grain.name
        count = int(chosen.sum())
        mesh = spec.add_mesh(name=f"look_{material.name}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        mesh.uservert = surface.triangles[chosen].astype(np.float32).ravel()
        mesh.usertexcoord = uv[chosen].astype(np.float32).ravel()
        mesh.userface = np.arange(3 * count, dtype=np.int32)
        mesh.userfacetexcoord = np.arange(3 * count, dtype=np.int32)
        part.add_geom(
            name=f"look_{material.name}",
            type=_G.mjGEOM_MESH,
            meshname=f"look_{material.name}",
            material=material.name,
            group=GROUP_PART,
            **VISUAL,
        )
    for k, solid in enumerate(workpiece.solids):
        _add_solid(part, spec, k, solid)


def _add_obstacle(spec: mujoco.MjSpec, radius_m: float) -> None:
    """A ball that is moved from outside; below the floor until then."""
    body = spec.worldbody.add_body(name=OBSTACLE, mocap=True, pos=[0.0, 0.0, 2 * _FLOOR_M])
    body.add_geom(
        name=OBSTACLE,
        type=_G.mjGEOM_SPHERE,
        size=[radius_m, 0, 0],
        rgba=[*SKIN_RGB, 1.0],
        group=GROUP_PART,
        **ENVIRONMENT,
    )


def _add_marker(spec: mujoco.MjSpec, workpiece: Workpiece, cell: CellCfg) -> "PartMarker":
    """The part's AR code and the camera above the cell that reads it."""
    from seal_gym.sim import markers  # loads OpenCV and SciPy: only for marked parts

    marker = markers.part_marker(workpiece, cell.marker)
    size = (marker.label_m, marker.label_m)
    markers.add_label(
        spec, spec.body("part"), "marker", marker.picture(16), size, marker.T_part_marker, GROUP_PART
    )
    camera = cell.overhead
    element = spec.worldbody.add_camera(
        name=OVERHEAD,
        pos=camera.pose[:3, 3],
        quat=quat_from_matrix(camera.pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])),
        resolution=list(camera.frame_px),
        focal_pixel=[camera.focal_px] * 2,
    )
    element.sensor_size = np.array(camera.frame_px) * 1e-5
    return marker


def _tool_triangles(model: mujoco.MjModel) -> Array:
    """The nozzle's triangles in the tip frame, from the compiled model."""
    geom = model.geom(GUN_PREFIX + "col_nozzle").id
    mesh = int(model.geom_dataid[geom])
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    # geom_pos and geom_quat hold the mesh's own frame as well; the gun's body is the flange's frame.
    points = model.mesh_vert[first : first + count].astype(np.float64) @ rotation.reshape(3, 3).T
    points += model.geom_pos[geom]
    tip = (points - T_TOOL0_TIP[:3, 3]) @ T_TOOL0_TIP[:3, :3]
    face = int(model.mesh_faceadr[mesh])
    return np.asarray(tip[model.mesh_face[face : face + int(model.mesh_facenum[mesh])]])


def build_scene(
    workpiece: Workpiece, cell: CellCfg, *, marked: bool = False, obstacle_m: float = 0.0
) -> Scene:
    """Composes and compiles the cell.

    World frame: the robot's DH base frame, z up. The part is a mocap body, so that it can be displaced
    at reset and moved during a run.

    Args:
        workpiece: The part.
        cell: Cameras, timing and limits.
        marked: With the AR code on the part and the overhead camera; they are seen, never felt.
        obstacle_m: Radius of a ball in the way, the second mocap body [m]; 0: none.

    Returns:
        The scene.

    Raises:
        PhysicsError: If MuJoCo does not accept the part's geometry.
        SeamError: If the part has no room for the AR code.
    """
    spec = mujoco.MjSpec.from_file(str(asset("ur5_sealgun", "ur5.xml")))
    gun = mujoco.MjSpec.from_file(str(asset("ur5_sealgun", "sealgun.xml")))
    spec.attach(gun, prefix=GUN_PREFIX, site=spec.site("tool0"))
    spec.option.timestep = cell.timing.step_s
    add_furniture(spec)
    _add_sensor_cameras(spec.body(GUN_PREFIX + "sealgun"), cell)
    _add_part(spec, workpiece)
    if obstacle_m > 0.0:
        _add_obstacle(spec, obstacle_m)
    marker = _add_marker(spec, workpiece, cell) if marked else None
    try:
        model = spec.compile()
    except ValueError as error:
        raise PhysicsError(f"workpiece {workpiece.name!r} cannot be simulated: {error}") from error
    return Scene(model=model, workpiece=workpiece, cell=cell, tool=_tool_triangles(model), marker=marker)


@lru_cache(maxsize=16)
def cached_scene(workpiece: Workpiece, cell: CellCfg, obstacle_m: float = 0.0) -> Scene:
    """``build_scene``, compiled once for each workpiece, cell and obstacle.

    Args:
        workpiece: The part.
        cell: Cameras, timing and limits.
        obstacle_m: As ``build_scene`` takes it.

    Returns:
        The scene; shared, so do not edit its model.
    """
    return build_scene(workpiece, cell, obstacle_m=obstacle_m)
