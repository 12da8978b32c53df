"""What a laydown simulation is made of: the fluid, the nozzle, the timed path of the tip, the grid."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from seal_gym.core.errors import ConfigError, SealGymError, is_number, require
from seal_gym.core.frames import Array
from seal_gym.sealant.laydown.substrates import SUBSTRATES, Substrate
from seal_gym.sealant.pneumatics import SEALANTS, Sealant

GRAVITY_MPS2 = 9.81
STANDARD_GRAVITY = (0.0, 0.0, -GRAVITY_MPS2)
SOLVERS = ("interFoam", "interIsoFoam")
# paper B 3.2.2: 15 g/s; its density is not given
THESIS_FLOW_M3S = 15e-3 / SEALANTS["neutral_silicone"].density_kg_m3


class LaydownError(SealGymError, RuntimeError):
    """A laydown simulation cannot be run or its result cannot be read."""


def _in_range(name: str, value: object, low: float, high: float, unit: str) -> None:
    ok = is_number(value) and low <= float(value) <= high  # type: ignore[arg-type]  # is_number is no type guard
    require(ok, f"{name} = {value!r}: must be a number in [{low:g}, {high:g}] {unit}")


@dataclass(frozen=True, kw_only=True)
class FluidCfg:
    """The sealant as the solver takes it.

    Attributes:
        sealant: The material.
        surface_tension_npm: Against air [N/m].
        viscosity_cap_pas: Viscosity of the unyielded fluid [Pa s]; the solver knows no rigid body. Below
            the shear rate yield stress / cap the yield stress is not held.
    """

    sealant: Sealant = SEALANTS["neutral_silicone"]
    surface_tension_npm: float = 0.03
    viscosity_cap_pas: float = 1000.0

    def __post_init__(self) -> None:
        require(
            isinstance(self.sealant, Sealant), f"sealant = {self.sealant!r}: must be a Sealant, see SEALANTS"
        )
        _in_range("surface_tension_npm", self.surface_tension_npm, 0.0, 0.2, "N/m")
        _in_range("viscosity_cap_pas", self.viscosity_cap_pas, 1.0, 1e5, "Pa s")


@dataclass(frozen=True, kw_only=True)
class NozzleCfg:
    """A nozzle that throws a free jet.

    Attributes:
        kind: ``"fan"``: a flat sheet, spread evenly over ``fan_angle_rad`` in the tip's xz plane (paper
            B 3.1.2.2); ``"round"``: a cylinder along the tip's -z.
        fan_angle_rad: The sheet's whole angle [rad].
        radius_m: Of the round jet [m].
        jet_speed_mps: Of the fluid relative to the tip [m/s]. A sheet's thickness at the distance r follows
            from it: flow / (fan_angle_rad r jet_speed_mps).
        strip_m: Thickness of the strip over which a sheet's fluid comes in [m].
    """

    kind: Literal["fan", "round"] = "fan"
    fan_angle_rad: float = math.radians(40.0)
    radius_m: float = 2e-3
    jet_speed_mps: float = 3.0
    strip_m: float = 2e-3

    def __post_init__(self) -> None:
        require(self.kind in ("fan", "round"), f"kind = {self.kind!r}: must be 'fan' or 'round'")
        _in_range("fan_angle_rad", self.fan_angle_rad, 0.05, 2.0, "rad")
        _in_range("radius_m", self.radius_m, 2e-4, 2e-2, "m")
        _in_range("jet_speed_mps", self.jet_speed_mps, 0.1, 20.0, "m/s")
        _in_range("strip_m", self.strip_m, 1e-4, 1e-2, "m")


@dataclass(frozen=True, kw_only=True)
class GridCfg:
    """Mesh, solver and time step.

    Attributes:
        cell_m: Edge of a cell [m].
        clearance_m: Height of the mesh above the highest part of the substrate [m].
        margin_m: Mesh around the area that the jet meets [m].
        solver: ``"interFoam"`` (interface compression) or ``"interIsoFoam"`` (geometric interface).
        courant: Largest Courant number.
        inlet_dt_s: Spacing of the jet's samples [s].
        settle_s: Time simulated after the last fluid came in [s].
    """

    cell_m: float = 1e-3
    clearance_m: float = 6e-3
    margin_m: float = 6e-3
    solver: str = "interFoam"
    courant: float = 0.5
    inlet_dt_s: float = 1e-3
    settle_s: float = 0.03

    def __post_init__(self) -> None:
        _in_range("cell_m", self.cell_m, 1e-4, 5e-3, "m")
        _in_range("clearance_m", self.clearance_m, 2e-3, 5e-2, "m")
        _in_range("margin_m", self.margin_m, 1e-3, 5e-2, "m")
        require(self.solver in SOLVERS, f"solver = {self.solver!r}: must be one of {', '.join(SOLVERS)}")
        _in_range("courant", self.courant, 0.05, 2.0, "")
        _in_range("inlet_dt_s", self.inlet_dt_s, 1e-5, 1e-2, "s")
        _in_range("settle_s", self.settle_s, 0.0, 10.0, "s")


@dataclass(frozen=True, kw_only=True, eq=False)
class TcpPath:
    """A timed path of the tip; between its points position and flow are linear, the rotation turns evenly.

    Attributes:
        times_s: Shape (n,), from 0, increasing [s].
        positions: Shape (n, 3), in the substrate's frame [m].
        rotations: ``R_substrate_tip``, shape (n, 3, 3): x to the right of travel, y along travel, z back
            along the nozzle.
        flows_m3s: Shape (n,), >= 0 [m3/s].
    """

    times_s: Array
    positions: Array
    rotations: Array
    flows_m3s: Array

    def __post_init__(self) -> None:
        n = len(self.times_s)
        shapes = (self.positions.shape, self.rotations.shape, self.flows_m3s.shape)
        require(
            n >= 2 and shapes == ((n, 3), (n, 3, 3), (n,)),
            f"TcpPath: {n} times with shapes {shapes}: must be at least 2 and (n, 3), (n, 3, 3), (n,)",
        )
        arrays = (self.times_s, self.positions, self.rotations, self.flows_m3s)
        require(all(np.isfinite(a).all() for a in arrays), "TcpPath: values must be finite")
        rising = self.times_s[0] == 0 and bool((np.diff(self.times_s) > 0).all())
        require(rising, f"times_s = {self.times_s}: must begin with 0 and increase")
        require(bool((self.flows_m3s >= 0).all()), "flows_m3s: must not be negative")
        identity = self.rotations @ np.swapaxes(self.rotations, -1, -2)
        require(
            bool(np.allclose(identity, np.eye(3), atol=1e-6) and (np.linalg.det(self.rotations) > 0).all()),
            "rotations: must be rotations (R R^T = 1, determinant 1)",
        )

    def at(self, times_s: Array) -> tuple[Array, Array, Array]:
        """The tip at given times.

        Args:
            times_s: Shape (m,), within the path's [s].

        Returns:
            Positions (m, 3) [m], rotations (m, 3, 3), flows (m,) [m3/s].
        """
        positions = np.stack([np.interp(times_s, self.times_s, p) for p in self.positions.T], -1)
        turn = Slerp(self.times_s, Rotation.from_matrix(self.rotations))
        rotations = turn(np.clip(times_s, 0.0, self.times_s[-1])).as_matrix()
        return positions, rotations, np.interp(times_s, self.times_s, self.flows_m3s)

    def velocities(self, times_s: Array) -> Array:
        """The tip's velocity, constant between the path's points.

        Args:
            times_s: Shape (m,), within the path's [s].

        Returns:
            Shape (m, 3) [m/s].
        """
        legs = np.diff(self.positions, axis=0) / np.diff(self.times_s)[:, None]
        leg = np.searchsorted(self.times_s, times_s, "right") - 1
        return np.asarray(legs[np.clip(leg, 0, len(legs) - 1)])

    def volume_m3(self) -> float:
        """What the nozzle gives along the whole path.

        Returns:
            The integral of the flow [m3].
        """
        return float(np.trapezoid(self.flows_m3s, self.times_s))


@dataclass(frozen=True, kw_only=True, eq=False)
class LaydownCfg:
    """One laydown simulation.

    Attributes:
        path: The tip's.
        substrate: Name, see ``substrates.SUBSTRATES``, or a part of one's own.
        fluid: The sealant.
        nozzle: What throws it.
        grid: Mesh, solver, time step.
        gravity_mps2: In the substrate's frame [m/s2].
    """

    path: TcpPath
    substrate: str | Substrate = "plane"
    fluid: FluidCfg = field(default_factory=FluidCfg)
    nozzle: NozzleCfg = field(default_factory=NozzleCfg)
    grid: GridCfg = field(default_factory=GridCfg)
    gravity_mps2: tuple[float, float, float] = STANDARD_GRAVITY

    def __post_init__(self) -> None:
        require(
            isinstance(self.substrate, Substrate) or self.substrate in SUBSTRATES,
            f"substrate = {self.substrate!r}: must be a Substrate or one of {', '.join(SUBSTRATES)}",
            ConfigError,
        )
        ok = np.shape(self.gravity_mps2) == (3,) and all(map(is_number, self.gravity_mps2))
        require(ok, f"gravity_mps2 = {self.gravity_mps2!r}: must be three numbers")

    @property
    def part(self) -> Substrate:
        """The substrate itself."""
        return self.substrate if isinstance(self.substrate, Substrate) else SUBSTRATES[self.substrate]
