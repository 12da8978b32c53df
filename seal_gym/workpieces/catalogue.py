"""The three nominal parts of the benchmark (Zhou et al., Fig. 11), with sizes of our own."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from seal_gym.core.errors import SeamError
from seal_gym.core.frames import yaw_pose
from seal_gym.workpieces import solids
from seal_gym.workpieces.seam import RUN_ON_M, Seam, build_seam
from seal_gym.workpieces.surface import PLATE, WALL, Surface
from seal_gym.workpieces.workpiece import PLATE_THICKNESS_M, Workpiece

_LEAN = np.sqrt(0.5)
_FACET = np.deg2rad(1.0)  # a facet of the 70 mm cylinder is 2.7 um short of the circle
_SEAM_STEP = np.deg2rad(0.5)


@lru_cache
def flat() -> Workpiece:
    """A straight fillet seam of 300 mm at the foot of a wall 30 mm high.

    Returns:
        The workpiece.
    """
    seam = build_seam([[-0.15, 0, 0], [0.15, 0, 0]], [0.0, -_LEAN, _LEAN])
    plate, plate_solid = solids.plate((-0.20, -0.09), (0.20, 0.04), PLATE_THICKNESS_M, PLATE)
    wall = solids.prism(np.array([[-0.19, 0], [0.19, 0], [0.19, 0.008], [-0.19, 0.008]]), 0.0, 0.03, WALL)
    return Workpiece(
        name="flat",
        seam=seam,
        surface=Surface.join(plate, wall),
        solids=(plate_solid, solids.box((-0.19, 0.0, 0.0), (0.19, 0.008, 0.03))),
        pose=yaw_pose(0.35, 0.0, -0.05, np.pi / 2),
    )


@lru_cache
def cylinder() -> Workpiece:
    """The foot of a cylinder of 70 mm radius, 40 mm high, on a plate: 180 deg, 220 mm.

    Returns:
        The workpiece.
    """
    radius, height = 0.07, 0.04
    past_end = int(np.ceil(RUN_ON_M / (radius * _SEAM_STEP)))
    angle = -np.pi / 2 + _SEAM_STEP * np.arange(-past_end, round(np.pi / _SEAM_STEP) + past_end + 1)
    zero, c, s = np.zeros_like(angle), np.cos(angle), np.sin(angle)
    position = radius * np.column_stack((c, s, zero))
    chord = float(np.linalg.norm(position[1] - position[0]))
    seam = Seam(
        position=position,
        tangent=np.column_stack((-s, c, zero)),
        approach=_LEAN * np.column_stack((c, s, zero + 1.0)),
        length=chord * round(np.pi / _SEAM_STEP),
        run_in=chord * past_end,
        corners=np.empty((0, 2)),
    )
    plate, plate_solid = solids.plate((-0.13, -0.15), (0.15, 0.15), PLATE_THICKNESS_M, PLATE)
    foot = solids.arc_points((0, 0), radius, 0.0, 2 * np.pi, _FACET)[:-1]
    return Workpiece(
        name="cylinder",
        seam=seam,
        surface=Surface.join(plate, solids.prism(foot, 0.0, height, WALL)),
        solids=(plate_solid, solids.cylinder((0.0, 0.0), radius, 0.0, height)),
        pose=yaw_pose(0.45, 0.0, -0.05, 0.0),
    )


@lru_cache
def rectangular() -> Workpiece:
    """Three sides of a box's foot, 110 / 144.3 / 110 mm, and two corners of 5 mm radius: 380 mm.

    Returns:
        The workpiece.
    """
    r, height = 5e-3, 0.03
    x0, x1, y = -0.095, 0.060, 0.07715
    start = -0.055
    vertices = [[start, -y, 0.0], [x1, -y, 0.0], [x1, y, 0.0], [start, y, 0.0]]
    out = np.array([[0.0, -1.0], [np.sqrt(0.5), -np.sqrt(0.5)], [np.sqrt(0.5), np.sqrt(0.5)], [0.0, 1.0]])
    approach = np.column_stack((_LEAN * out, np.full(4, _LEAN)))
    corners = [((x0 + r, -y + r), 180), ((x1 - r, -y + r), 270), ((x1 - r, y - r), 0), ((x0 + r, y - r), 90)]
    foot = np.concatenate(
        [
            solids.arc_points(centre, r, np.deg2rad(first), np.deg2rad(first + 90), _FACET)
            for centre, first in corners
        ]
    )
    plate, plate_solid = solids.plate((-0.115, -0.15), (0.14, 0.15), PLATE_THICKNESS_M, PLATE)
    return Workpiece(
        name="rectangular",
        seam=build_seam(vertices, approach, corner_radius=r),
        surface=Surface.join(plate, solids.prism(foot, 0.0, height, WALL)),
        # A plain box would stand 2 mm proud of the rounded corners.
        solids=(
            plate_solid,
            solids.box((x0 + r, -y, 0.0), (x1 - r, y, height)),
            solids.box((x0, -y + r, 0.0), (x1, y - r, height)),
            *(solids.cylinder(centre, r, 0.0, height) for centre, _ in corners),
        ),
        pose=yaw_pose(0.45, 0.0, -0.05, 0.0),
    )


_CATALOGUE: dict[str, Callable[[], Workpiece]] = {
    "flat": flat,
    "cylinder": cylinder,
    "rectangular": rectangular,
}
NAMES = tuple(_CATALOGUE)


def get(workpiece: object) -> Workpiece:
    """A workpiece by name; a workpiece of the user's passes through.

    Args:
        workpiece: A name or a workpiece.

    Returns:
        The workpiece.

    Raises:
        SeamError: If there is no such name.
    """
    if isinstance(workpiece, Workpiece):
        return workpiece
    if not isinstance(workpiece, str) or workpiece not in _CATALOGUE:
        raise SeamError(
            f"workpiece = {workpiece!r}: must be one of {list(NAMES)} or a Workpiece "
            "(Workpiece.from_polyline, Workpiece.from_mesh)"
        )
    return _CATALOGUE[workpiece]()
