"""Centre paths on named substrates and random tip paths around them (paper B 3.2.2, Table 3.1)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from seal_gym.core.frames import Array, normalise, tip_rotation
from seal_gym.sealant.laydown.config import GRAVITY_MPS2, STANDARD_GRAVITY, THESIS_FLOW_M3S, TcpPath
from seal_gym.sealant.laydown.substrates import SUBSTRATES

KNOT_M = 20e-3  # between random draws along a centre path
_POSE_M = 5e-3  # between the points of a tip path
_FINE_M = 1e-4
_HALF = math.sqrt(0.5) * GRAVITY_MPS2


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """What a tip path's parameters are drawn from: uniform at its start, then normal around that.

    Attributes:
        offset_m: Tip to centre path: low, high, standard deviation [m].
        speed_mps: Of the tip [m/s].
        tilt_rad: About the direction of travel [rad].
        drag_rad: About the axis to the right [rad].
        spin_rad: About the nozzle [rad].
    """

    offset_m: tuple[float, float, float] = (20e-3, 40e-3, 2.5e-3)
    speed_mps: tuple[float, float, float] = (0.2, 0.5, 0.02)
    tilt_rad: tuple[float, float, float] = (-math.pi / 6, math.pi / 6, math.radians(7.5))
    drag_rad: tuple[float, float, float] = (-math.pi / 12, math.pi / 12, math.radians(5.0))
    spin_rad: tuple[float, float, float] = (-math.radians(75), math.radians(75), math.radians(3.75))

    def draw(self, knots: int, rng: np.random.Generator) -> Array:
        """Draws the parameters of one path.

        Args:
            knots: Points along the centre path.
            rng: The source of chance.

        Returns:
            Offset [m], speed [m/s], tilt, drag, spin [rad] by knot, shape (knots, 5), all within the bounds.
        """
        low, high, deviation = np.array(
            (self.offset_m, self.speed_mps, self.tilt_rad, self.drag_rad, self.spin_rad)
        ).T
        first = rng.uniform(low, high)
        later = rng.normal(first, deviation, (knots - 1, len(first)))
        return np.asarray(np.clip(np.vstack((first, later)), low, high))


@dataclass(frozen=True, kw_only=True)
class CentrePath:
    """A curve on a substrate that the nozzle points at.

    Attributes:
        name: Of the path.
        substrate: Name.
        legs: (length [m], curvature to the left [1/m]) of each piece.
        heading_rad: Of the start, from the y axis to the left [rad].
        shift_m: Of the curve's bounding box from the substrate's origin: x, y [m].
        gravity_mps2: In the substrate's frame [m/s2].
        surface_normal: Whether the nozzle stands along the substrate's normal, else along its z axis.
        tilt_limit_rad: Bound of the tilt where it is less than the thesis's [rad].
    """

    name: str
    substrate: str
    legs: tuple[tuple[float, float], ...] = ((60e-3, 0.0),)
    heading_rad: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)
    gravity_mps2: tuple[float, float, float] = STANDARD_GRAVITY
    surface_normal: bool = False
    tilt_limit_rad: float = math.pi / 6

    @property
    def length_m(self) -> float:
        """Its length, seen from above [m]."""
        return sum(length for length, _ in self.legs)

    def frames(self, arcs_m: Array) -> tuple[Array, Array]:
        """Centre points and upright tip orientations.

        Args:
            arcs_m: Arc length seen from above, shape (n,) [m].

        Returns:
            Points (n, 3) [m] and ``R_substrate_tip`` without tilt, drag, spin (n, 3, 3).
        """
        fine = np.linspace(0.0, self.length_m, round(self.length_m / _FINE_M) + 1)
        ends = np.cumsum([length for length, _ in self.legs])
        bend = np.array([k for _, k in self.legs])
        middle = 0.5 * (fine[1:] + fine[:-1])
        curvature = bend[np.searchsorted(ends, middle).clip(max=len(bend) - 1)]
        turned = self.heading_rad + np.append(0.0, np.cumsum(curvature * np.diff(fine)))
        mid = 0.5 * (turned[1:] + turned[:-1])
        step = np.diff(fine)[:, None] * np.stack((-np.sin(mid), np.cos(mid)), -1)
        xy = np.vstack((np.zeros(2), np.cumsum(step, 0)))
        xy += np.array(self.shift_m) - 0.5 * (xy.min(0) + xy.max(0))
        x, y, heading = (np.interp(arcs_m, fine, v) for v in (*xy.T, turned))
        part = SUBSTRATES[self.substrate]
        normal = part.normal(x, y) if self.surface_normal else np.tile([0.0, 0.0, 1.0], (len(x), 1))
        ahead = np.stack((-np.sin(heading), np.cos(heading), np.zeros_like(x)), -1)
        ahead = normalise(ahead - (ahead * normal).sum(1, keepdims=True) * normal)
        return np.stack((x, y, part.height(x, y)), -1), tip_rotation(ahead, normal)


def tip_path(centre: CentrePath, draws: Array, flow_m3s: float = THESIS_FLOW_M3S) -> TcpPath:
    """The timed path of a tip on spheres around the points of a centre path.

    Args:
        centre: The centre path.
        draws: From ``Bounds.draw``, evenly spaced along the centre path, linear between.
        flow_m3s: Of sealant, constant [m3/s].

    Returns:
        Poses about every 5 mm; the nozzle always points at the centre path.
    """
    arcs = np.linspace(0.0, centre.length_m, math.ceil(centre.length_m / _POSE_M) + 1)
    at = np.linspace(0.0, centre.length_m, len(draws))
    offset, speed, tilt, drag, spin = (np.interp(arcs, at, column) for column in draws.T)
    points, upright = centre.frames(arcs)
    turn = Rotation.from_euler("YXZ", np.stack((tilt, drag, spin), -1)).as_matrix()
    rotations = upright @ turn
    positions = points + offset[:, None] * rotations[:, :, 2]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    times = np.append(0.0, np.cumsum(steps / (0.5 * (speed[1:] + speed[:-1]))))
    return TcpPath(
        times_s=times, positions=positions, rotations=rotations, flows_m3s=np.full(len(arcs), flow_m3s)
    )


def random_tip_path(
    centre: CentrePath,
    rng: np.random.Generator,
    bounds: Bounds | None = None,
    flow_m3s: float = THESIS_FLOW_M3S,
) -> TcpPath:
    """Draws a tip path around a centre path.

    Args:
        centre: The centre path.
        rng: The source of chance.
        bounds: Of the parameters; by default the thesis's, the tilt as the centre path allows.
        flow_m3s: Of sealant [m3/s].

    Returns:
        The path.
    """
    limit = centre.tilt_limit_rad
    bounds = bounds or Bounds(tilt_rad=(-limit, limit, math.radians(7.5)))
    knots = math.ceil(centre.length_m / KNOT_M - 1e-9) + 1
    return tip_path(centre, bounds.draw(knots, rng), flow_m3s)


def _arc(length_m: float, radius_m: float) -> tuple[tuple[float, float], ...]:
    return ((length_m, 1.0 / radius_m),)


def _make() -> tuple[tuple[CentrePath, ...], tuple[CentrePath, ...]]:
    make: Callable[..., CentrePath] = CentrePath
    s_curve = ((30e-3, 1 / 30e-3), (30e-3, -1 / 30e-3))
    zigzag = tuple((15e-3, sign / 12e-3) for sign in (1, -1, 1, -1))
    corner_leg = ((24e-3, 0.0), (8e-3 * math.pi / 2, 1 / 8e-3), (24e-3, 0.0))
    hairpin = ((10e-3, 0.0), (15e-3 * math.pi, -1 / 15e-3), (10e-3, 0.0))
    narrow = math.radians(15.0)
    diagonal = math.pi / 4
    training = (
        make(name="plane_straight", substrate="plane"),
        make(name="plane_left", substrate="plane", legs=_arc(60e-3, 40e-3)),
        make(name="plane_right", substrate="plane", legs=_arc(60e-3, -40e-3)),
        make(name="plane_wide", substrate="plane", legs=_arc(60e-3, 100e-3)),
        make(name="plane_s", substrate="plane", legs=s_curve),
        make(name="plane_corner", substrate="plane", legs=corner_leg),
        make(name="plane_zigzag", substrate="plane", legs=zigzag),
        make(name="plane_hairpin", substrate="plane", legs=hairpin),
        make(name="wall_level", substrate="plane", gravity_mps2=(GRAVITY_MPS2, 0.0, 0.0)),
        make(name="wall_up", substrate="plane", gravity_mps2=(0.0, -GRAVITY_MPS2, 0.0)),
        make(name="overhead", substrate="plane", gravity_mps2=(0.0, 0.0, GRAVITY_MPS2)),
        make(name="step_edge", substrate="step"),
        make(name="step_top", substrate="step", shift_m=(6e-3, 0.0)),
        make(name="step_foot", substrate="step", shift_m=(-6e-3, 0.0)),
        make(name="trench_along", substrate="trench"),
        make(name="trench_beside", substrate="trench", shift_m=(5e-3, 0.0)),
        make(name="gap_along", substrate="gap"),
        make(
            name="corner_floor",
            substrate="inner_corner",
            tilt_limit_rad=narrow,
            gravity_mps2=(-_HALF, 0.0, -_HALF),
        ),
        make(
            name="corner_ceiling",
            substrate="inner_corner",
            tilt_limit_rad=narrow,
            gravity_mps2=(_HALF, 0.0, _HALF),
        ),
        make(name="outer_beside", substrate="outer_corner", shift_m=(-7e-3, 0.0)),
        make(name="outer_edge", substrate="outer_corner", shift_m=(-2e-3, 0.0)),
        make(name="ridge_crest", substrate="ridge"),
        make(name="ridge_flank", substrate="ridge", shift_m=(8e-3, 0.0), surface_normal=True),
        make(name="ridge_across", substrate="ridge", heading_rad=-math.pi / 2, surface_normal=True),
        make(name="ridge_oblique", substrate="ridge", heading_rad=diagonal, surface_normal=True),
    )
    validation = (
        make(name="stairs_edge", substrate="stairs", shift_m=(4e-3, 0.0)),
        make(name="stairs_tread", substrate="stairs", legs=_arc(60e-3, 120e-3)),
        make(name="ramp_foot", substrate="ramp"),
        make(name="ramp_oblique", substrate="ramp", heading_rad=-diagonal),
        make(name="vee_along", substrate="vee"),
        make(name="vee_oblique", substrate="vee", heading_rad=diagonal),
        make(name="wave_along", substrate="wave", surface_normal=True),
        make(name="wave_oblique", substrate="wave", heading_rad=diagonal, legs=_arc(60e-3, 80e-3)),
        make(name="dome_across", substrate="dome", shift_m=(4e-3, 0.0), surface_normal=True),
        make(name="box_side", substrate="box"),
        make(name="pocket_along", substrate="pocket"),
        make(name="joggle_along", substrate="joggle", shift_m=(-2e-3, 0.0)),
    )
    return training, validation


TRAINING, VALIDATION = _make()
