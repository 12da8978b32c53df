"""Cross-sections of a laid bead and the surrogate's inputs beside them (paper B 3.2.3)."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from seal_gym.core.frames import Array, normalise
from seal_gym.sealant.laydown.config import LaydownCfg, LaydownError
from seal_gym.sealant.laydown.jet import fly
from seal_gym.sealant.laydown.mesh import Mesh
from seal_gym.sealant.laydown.substrates import Substrate

COLUMNS, ROWS = 40, 20
PIXEL_M = 1e-3
BELOW_M = 8e-3  # of the window, under the place that the nozzle points at
RAYS = 41
RAY_LIMIT_M = 0.1
_SPACING_M = 1e-3
_SUB = 4  # samples of a pixel, each way
_BEAD_M = 0.5e-3  # a column is bead from this height on


@dataclass(frozen=True)
class Stations:
    """Places along a tip path, 1 mm apart, and what the surrogate knows there.

    Attributes:
        times_s: Shape (n,).
        arcs_m: Along the tip's path, shape (n,).
        linear_mps: The tip's velocity to the next station, in its frame, shape (n, 3).
        angular_radps: The tip's angular velocity to the next station, in its frame, shape (n, 3).
        gravity_mps2: In the tip's frame, shape (n, 3).
        heights_m: Along -z from points 1 mm apart on the tip's x axis, left to right, to the substrate; at
            most ``RAY_LIMIT_M``: shape (n, 41).
        hits: Where the nozzle points at, shape (n, 3) [m].
        tips: ``R_substrate_tip``, shape (n, 3, 3).
        across: Frames with y along the hits' travel from above, z the substrate's, shape (n, 3, 3).
        ideal_m2: Flow / speed of the hits seen from above: the area of a cut across travel, shape (n,).
    """

    times_s: Array
    arcs_m: Array
    linear_mps: Array
    angular_radps: Array
    gravity_mps2: Array
    heights_m: Array
    hits: Array
    tips: Array
    across: Array
    ideal_m2: Array


def _cast(part: Substrate, start: Array, direction: Array) -> tuple[Array, Array]:
    """Distances along rays (n,) and hits (n, 3)."""
    reach, place, _ = fly(start, direction, np.zeros(3), part.height, reach_s=RAY_LIMIT_M)
    return reach, place


def stations(cfg: LaydownCfg) -> Stations:
    """Places along a simulation's path.

    Args:
        cfg: The simulation.

    Returns:
        One a millimetre of the tip's path.

    Raises:
        LaydownError: If the nozzle points past the substrate.
    """
    path, part = cfg.path, cfg.part
    knots = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path.positions, axis=0), axis=1)))
    arcs = np.arange(0.0, knots[-1], _SPACING_M)
    times = np.interp(np.append(arcs, min(arcs[-1] + _SPACING_M, knots[-1])), knots, path.times_s)
    positions, rotations, flows = path.at(times)
    dt = np.diff(times)[:, None]
    inverse = np.swapaxes(rotations[:-1], -1, -2)
    linear = np.einsum("nij,nj->ni", inverse, np.diff(positions, axis=0) / dt)
    angular = Rotation.from_matrix(inverse @ rotations[1:]).as_rotvec() / dt
    side = (np.arange(RAYS) - RAYS // 2) * PIXEL_M
    start = positions[:-1, None] + side[:, None] * rotations[:-1, None, :, 0]
    down = np.repeat(-rotations[:-1, None, :, 2], RAYS, 1)
    heights, _ = _cast(part, start.reshape(-1, 3), down.reshape(-1, 3))
    _, hits = _cast(part, positions, -rotations[:, :, 2])
    if np.isnan(hits).any():
        raise LaydownError("the nozzle points past the substrate: tilt or drag less")
    travel = np.diff(hits, axis=0) * [1.0, 1.0, 0.0]
    speed = np.linalg.norm(travel, axis=1) / dt[:, 0]
    ahead = normalise(travel)
    up = np.tile([0.0, 0.0, 1.0], (len(ahead), 1))
    across = np.stack((np.cross(ahead, up), ahead, up), -1)
    return Stations(
        times[:-1],
        arcs,
        linear,
        angular,
        np.einsum("nij,j->ni", inverse, np.asarray(cfg.gravity_mps2)),
        np.nan_to_num(heights, nan=RAY_LIMIT_M).reshape(len(arcs), RAYS),
        hits[:-1],
        rotations[:-1],
        across,
        flows[:-1] / speed,
    )


def cut(mesh: Mesh, fractions: Array, hits: Array, frames: Array) -> Array:
    """Cuts windows of 40 x 20 mm out of a volume-fraction field.

    Args:
        mesh: Its mesh.
        fractions: By cell, shape (cells,).
        hits: Points in the windows' middle column, ``BELOW_M`` above their lower edge, shape (n, 3) [m].
        frames: Rotations whose x is to the right and whose z is up in the windows, shape (n, 3, 3).

    Returns:
        Volume fractions in [0, 1], shape (n, 20, 40): rows up from the lowest, columns to the right.
    """
    fine = PIXEL_M / _SUB
    u = (np.arange(COLUMNS * _SUB) + 0.5) * fine - 0.5 * COLUMNS * PIXEL_M
    w = (np.arange(ROWS * _SUB) + 0.5) * fine - BELOW_M
    padded = np.append(np.clip(fractions, 0.0, 1.0), 0.0)  # what index -1 finds
    images = []
    for hit, frame in zip(hits, frames, strict=True):
        points = hit + w[:, None, None] * frame[:, 2] + u[None, :, None] * frame[:, 0]
        images.append(padded[mesh.cells_at(points)].reshape(ROWS, _SUB, COLUMNS, _SUB).mean((1, 3)))
    return np.array(images)


def area_m2(images: Array) -> Array:
    """Areas of cross-sections.

    Args:
        images: Volume fractions, shape (..., 20, 40).

    Returns:
        Shape (...) [m2].
    """
    return np.asarray(images.sum((-1, -2)) * PIXEL_M**2)


def height_m(images: Array) -> Array:
    """Largest thickness of a bead, column by column.

    Args:
        images: Volume fractions, shape (..., 20, 40).

    Returns:
        Shape (...) [m].
    """
    return np.asarray(images.sum(-2).max(-1) * PIXEL_M)


def width_m(images: Array) -> Array:
    """Distance between the outermost places where a bead is 0.5 mm thick, linear between columns.

    Args:
        images: Volume fractions, shape (..., 20, 40).

    Returns:
        Shape (...) [m]; 0 without a bead.
    """
    thick = np.pad(images.sum(-2) * PIXEL_M, [(0, 0)] * (images.ndim - 2) + [(1, 1)])

    def edge(thick: Array) -> Array:
        bead = thick >= _BEAD_M
        first = bead.argmax(-1)[..., None]
        inner = np.take_along_axis(thick, first, -1)
        outer = np.take_along_axis(thick, np.maximum(first - 1, 0), -1)
        part = np.divide(inner - _BEAD_M, inner - outer, out=np.zeros_like(inner), where=inner > outer)
        return np.asarray((first - part)[..., 0])

    left, right = edge(thick), edge(thick[..., ::-1])
    return np.where((thick >= _BEAD_M).any(-1), (thick.shape[-1] - 1 - left - right) * PIXEL_M, 0.0)


def iou(a: Array, b: Array) -> Array:
    """Intersection over union of what is more than half full.

    Args:
        a: Volume fractions, shape (..., 20, 40).
        b: Likewise.

    Returns:
        Shape (...), 1 where both are empty.
    """
    one, two = a > 0.5, b > 0.5
    union = (one | two).sum((-1, -2))
    return np.where(union > 0, (one & two).sum((-1, -2)) / np.maximum(union, 1), 1.0)
