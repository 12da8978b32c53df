"""Workpieces: a seam, the surface a camera sees and the solids a gun can hit."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import SeamError, require
from seal_gym.core.frames import Array, cross, normalise, yaw_pose
from seal_gym.workpieces import solids
from seal_gym.workpieces.mesh import convex_pieces, read_mesh
from seal_gym.workpieces.seam import FILLET_LEAN_RAD, RUN_ON_M, Seam, build_seam
from seal_gym.workpieces.solids import Solid
from seal_gym.workpieces.surface import PLATE, WALL, Surface

Joint = Literal["fillet", "groove"]
PLATE_THICKNESS_M = 0.02
WALL_HEIGHT_M = (0.025, 0.040)
_PLATE_MARGIN_M = 0.06
# Where the middle of a part's seam stands unless a pose is given, in the robot's base frame [m].
_MIDDLE_M = (0.45, 0.0, -0.05)
Pose = tuple[float, float, float, float]
_MAX_GROOVE_LEAN_RAD = np.deg2rad(20.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Workpiece:
    """A part to be sealed, described in its own frame: the plate's top is the xy plane, z is up.

    Attributes:
        name: Shown in tables and pictures.
        seam: The curve to be sealed.
        surface: What cameras see.
        solids: What gun, arm and cameras can hit.
        pose: Nominal ``T_base_part`` [m]; each episode displaces it (see ``SealTaskCfg``).
        placed: Whether the user chose the pose; if not, the environment takes another where this one fails.
        groove_width: Of the groove whose middle is the seam, and its depth [m]; 0 in a fillet.
    """

    name: str
    seam: Seam
    surface: Surface
    solids: tuple[Solid, ...]
    pose: Array
    placed: bool = True
    groove_width: float = 0.0

    @classmethod
    def from_polyline(
        cls,
        points: ArrayLike,
        approach: ArrayLike,
        *,
        joint: Joint = "fillet",
        corner_radius: float = 5e-3,
        name: str = "polyline",
        wall_height: float = 0.03,
        groove_width: float = 2e-3,
        pose: Pose | None = None,
    ) -> Self:
        """A plate with a wall swept along a polyline, or with a groove milled along it.

        Args:
            points: In order of travel, in the part's frame, shape (n, 3), m. In a fillet z may rise above
                the plate: the floor then follows on a ledge. A groove lies in the plate's plane.
            approach: Unit directions from the seam back along the nozzle (the tip's z), shape (n, 3) or
                (3,). In a fillet the wall stands on the side it leans away from.
            joint: ``"fillet"`` or ``"groove"``.
            corner_radius: Rounds the polyline's corners [m].
            name: Shown in tables and pictures.
            wall_height: Of a fillet's wall [m], 25-40 mm.
            groove_width: Of a groove [m], at most the mouth's diameter.
            pose: Nominal x, y, z [m] and yaw [rad] of the part's frame in the robot's base frame; by default
                not turned, the plate on the table, the seam's middle 0.45 m in front of the robot, or, if the
                arm cannot seal it there, a place and an angle where it can.

        Returns:
            The workpiece.

        Raises:
            SeamError: See ``build_seam``; and if the lean does not fit the joint, a size is out of its
                range, or the wall would fold on itself.
        """
        require(
            joint in get_args(Joint),
            f"joint = {joint!r}: must be one of {list(get_args(Joint))}",
            SeamError,
        )
        seam = build_seam(points, approach, corner_radius=corner_radius)
        build = _fillet if joint == "fillet" else _groove
        size = wall_height if joint == "fillet" else groove_width
        surface, pieces = build(seam, size)
        return cls(
            name=name,
            seam=seam,
            surface=surface,
            solids=tuple(pieces),
            pose=_place(pose, seam),
            placed=pose is not None,
            groove_width=groove_width if joint == "groove" else 0.0,
        )

    @classmethod
    def from_mesh(
        cls,
        path: str | Path,
        seam: ArrayLike,
        approach: ArrayLike,
        *,
        corner_radius: float = 5e-3,
        name: str | None = None,
        scale: float = 1.0,
        pose: Pose | None = None,
    ) -> Self:
        """A part from a mesh file, with its seam given as a polyline.

        Args:
            path: STL or OBJ file; z is up.
            seam: Points of the seam in the mesh's frame, in order of travel, shape (n, 3), m.
            approach: Unit directions from the seam back along the nozzle, shape (n, 3) or (3,).
            corner_radius: Rounds the polyline's corners [m].
            name: Shown in tables and pictures; the file's name by default.
            scale: Metres per unit of the file (0.001 for millimetres).
            pose: Nominal x, y, z [m] and yaw [rad] of the part's frame in the robot's base frame; by default
                not turned, the plate on the table, the seam's middle 0.45 m in front of the robot, or, if the
                arm cannot seal it there, a place and an angle where it can.

        Returns:
            The workpiece. It collides as it looks, concave or not (``convex_pieces``).

        Raises:
            SeamError: See ``build_seam`` and ``read_mesh``; and if the seam does not lie on the mesh or
                the pose is not four numbers.
        """
        path = Path(path)
        triangles = read_mesh(path, scale)
        curve = build_seam(seam, approach, corner_radius=corner_radius)
        inside = (curve.arc >= 0) & (curve.arc <= curve.length)
        gap = _distance_to_triangles(curve.position[inside][:: max(1, inside.sum() // 64)], triangles)
        require(
            bool(gap.max() < 2e-3),
            f"the seam is {gap.max() * 1e3:.1f} mm off the mesh {path.name!r}: at most 2 mm; check the units "
            f"(scale = {scale:g}) and the frame",
            SeamError,
        )
        blank = Surface(triangles=triangles, material=np.zeros(len(triangles), np.int32))
        level = np.abs(blank.normals[:, 2]) > np.cos(np.deg2rad(45.0))
        material = np.where(level, PLATE, WALL).astype(np.int32)
        return cls(
            name=name or path.stem,
            seam=curve,
            surface=Surface(triangles=triangles, material=material),
            solids=tuple(convex_pieces(triangles)),
            pose=_place(pose, curve),
            placed=pose is not None,
        )


def _place(pose: Pose | None, seam: Seam) -> Array:
    """``T_base_part`` of a pose, or the default's."""
    if pose is None:
        inside = seam.position[(seam.arc >= 0) & (seam.arc <= seam.length)]
        middle = (inside.min(axis=0) + inside.max(axis=0)) / 2
        return yaw_pose(_MIDDLE_M[0] - middle[0], _MIDDLE_M[1] - middle[1], _MIDDLE_M[2], 0.0)
    require(
        np.shape(pose) == (4,) and bool(np.all(np.isfinite(pose))),
        f"pose = {pose!r}: must be 4 finite numbers x, y, z [m], yaw [rad]",
        SeamError,
    )
    return yaw_pose(*pose)


def _extent(seam: Seam, margin: float) -> tuple[tuple[float, float], tuple[float, float]]:
    low, high = seam.position[:, :2].min(axis=0) - margin, seam.position[:, :2].max(axis=0) + margin
    return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))


def _once(seam: Seam) -> slice:
    """The samples that the part carries: all, but of a closed seam only one round, without its run-on."""
    if not seam.closed:
        return slice(None)
    first, last = np.searchsorted(seam.arc, [-1e-9, seam.length + 1e-9])
    return slice(int(first), int(last))


def _fillet(seam: Seam, wall_height: float) -> tuple[Surface, list[Solid]]:
    low, high = WALL_HEIGHT_M
    require(
        low <= wall_height <= high,
        f"wall_height = {wall_height!r}: must be in {low}..{high} m; a lower wall's top edge is taken for "
        "the seam, a higher one blocks the side camera",
        SeamError,
    )
    # Against the floor, which follows the seam, so across it.
    lean = np.arccos(np.clip(np.sum(seam.approach * seam.up, axis=1), -1.0, 1.0))
    low, high = FILLET_LEAN_RAD
    require(
        bool(np.all((lean > low - 1e-6) & (lean < high + 1e-6))),
        f"the approach direction leans {np.rad2deg(lean.min()):.1f}..{np.rad2deg(lean.max()):.1f} deg from "
        f"the plate's normal: a fillet needs {np.rad2deg(low):.0f}..{np.rad2deg(high):.0f} deg, or the "
        "nozzle touches",
        SeamError,
    )
    z = seam.position[:, 2]
    require(
        bool(z.min() > -1e-9),
        f"the seam goes {-z.min() * 1e3:.2f} mm below the plate: z must be >= 0 everywhere, its run-on of "
        f"{RUN_ON_M * 1e3:.0f} mm past both ends included",
        SeamError,
    )
    across = seam.approach * [1.0, 1.0, 0.0]
    outward = normalise(across - seam.tangent * np.sum(across * seam.tangent, axis=1, keepdims=True))
    outward = normalise(outward * [1.0, 1.0, 0.0])
    # The back of the wall must not fold where the seam bends round it.
    turning = np.diff(outward, axis=0)
    bend = np.sum(turning * np.diff(seam.position, axis=0), axis=1) / np.diff(seam.arc) ** 2
    convex, hollow = float(max(bend.max(), 0.0)), float(max(-bend.min(), 0.0))
    thickness = min(6e-3, 0.6 / convex if convex > 0 else np.inf)
    surface, plate = solids.plate(*_extent(seam, _PLATE_MARGIN_M), PLATE_THICKNESS_M, PLATE)
    once = _once(seam)
    curve, outward = seam.position[once], outward[once]
    wall, pieces = solids.sweep_wall(curve, outward, thickness, wall_height, WALL)
    parts = [surface, wall]
    if z.max() > 1e-9:
        width = min(0.025, 0.6 / hollow if hollow > 0 else np.inf)
        ledge, blocks = solids.sweep_ledge(curve, outward, width, PLATE)
        parts.append(ledge)
        pieces += blocks
    return Surface.join(*parts), [plate, *pieces]


def _groove(seam: Seam, groove_width: float) -> tuple[Surface, list[Solid]]:
    limit = 2 * load_cell().process.mouth_radius_m
    require(
        5e-4 <= groove_width <= limit,
        f"groove_width = {groove_width!r}: must be in 0.0005..{limit} m; the mouth must span the groove",
        SeamError,
    )
    require(
        bool(np.all(np.abs(seam.position[:, 2]) < 1e-9)),
        "a groove lies in the plate's plane: give points with z = 0, or use joint='fillet'",
        SeamError,
    )
    lean = float(np.arccos(np.clip(seam.approach[:, 2], -1.0, 1.0)).max())
    require(
        lean <= _MAX_GROOVE_LEAN_RAD + 1e-6,
        f"the approach direction leans {np.rad2deg(lean):.1f} deg: over a groove at most "
        f"{np.rad2deg(_MAX_GROOVE_LEAN_RAD):.0f} deg from the plate's normal",
        SeamError,
    )
    right = normalise(cross(seam.tangent, np.array([0.0, 0.0, 1.0])))
    once = _once(seam)
    surface, lower, upper = solids.groove_plate(
        seam.position[once], right[once], groove_width / 2, groove_width, _PLATE_MARGIN_M, (PLATE, WALL)
    )
    # The mouth spans the groove, so a plate without one stops it at the same places.
    rim = solids.rim(lower, upper, PLATE_THICKNESS_M, PLATE)
    return Surface.join(surface, rim), [solids.box((*lower, -PLATE_THICKNESS_M), (*upper, 0.0))]


def _distance_to_triangles(points: Array, triangles: Array) -> Array:
    """Distance from each point to the nearest triangle, shape (k,), m."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal = cross(ab, ac)
    area2 = np.maximum(np.sum(normal**2, axis=1), 1e-30)
    out = np.empty(len(points))
    for k, p in enumerate(points):
        ap = p - a
        v = np.sum(cross(ap, ac) * normal, axis=1) / area2
        w = np.sum(cross(ab, ap) * normal, axis=1) / area2
        inside = (v >= 0) & (w >= 0) & (v + w <= 1)
        best = np.where(inside, np.abs(np.sum(ap * normal, axis=1)) / np.sqrt(area2), np.inf).min()
        for i, j in ((0, 1), (1, 2), (2, 0)):
            start, edge = triangles[:, i], triangles[:, j] - triangles[:, i]
            t = np.clip(
                np.sum((p - start) * edge, axis=1) / np.maximum(np.sum(edge**2, axis=1), 1e-30), 0.0, 1.0
            )
            best = min(best, float(np.linalg.norm(p - start - t[:, None] * edge, axis=1).min()))
        out[k] = best
    return out
