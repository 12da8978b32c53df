"""From the commanded air pressure to the sealant's flow: valve and line, then a paste in a tube."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array

# Nodes per frame of the flow's integral: the pressure is a smooth exponential, so this is exact to rounding
# except in the frame in which the fluid begins to yield.
_NODES, _WEIGHTS = (np.asarray(x) for x in np.polynomial.legendre.leggauss(5))
_BISECTIONS = 200


@dataclass(frozen=True, kw_only=True)
class Sealant:
    """A Herschel-Bulkley fluid: tau = tau_y + K gamma^n where it yields.

    Attributes:
        name: Shown in tables.
        density_kg_m3: Density [kg/m^3].
        yield_stress_pa: Stress below which it does not flow, tau_y [Pa].
        consistency_pa_sn: K [Pa s^n].
        flow_index: n, below 1 for fluids that thin when sheared.
        rgb: Diffuse albedo, 3 numbers in 0..1.
    """

    name: str
    density_kg_m3: float
    yield_stress_pa: float
    consistency_pa_sn: float
    flow_index: float
    rgb: tuple[float, float, float] = (0.62, 0.20, 0.14)

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, low, high in (
            ("density_kg_m3", 500.0, 3000.0),
            ("yield_stress_pa", 0.0, 1e4),
            ("consistency_pa_sn", 1e-3, 1e5),
            ("flow_index", 0.1, 1.5),
        ):
            value = getattr(self, name)
            require(
                is_number(value) and low <= value <= high,
                f"Sealant.{name} = {value!r}: must be a number in {low:g}..{high:g}",
            )
        require(
            np.shape(self.rgb) == (3,) and all(0.0 <= c <= 1.0 for c in self.rgb),
            f"Sealant.rgb = {self.rgb!r}: must be 3 numbers in 0..1",
        )


# Within the ranges usual for one-component sealants (yield stress 100-500 Pa, K 50-600 Pa s^n, n 0.3-0.5);
# the self-levelling one runs, as a contrast. No primary table is behind the single values: vary them.
SEALANTS = {
    s.name: s
    for s in (
        Sealant(
            name="neutral_silicone",
            density_kg_m3=1400.0,
            yield_stress_pa=200.0,
            consistency_pa_sn=250.0,
            flow_index=0.40,
        ),
        Sealant(
            name="acetoxy_silicone",
            density_kg_m3=1030.0,
            yield_stress_pa=120.0,
            consistency_pa_sn=120.0,
            flow_index=0.45,
        ),
        Sealant(
            name="polyurethane",
            density_kg_m3=1250.0,
            yield_stress_pa=400.0,
            consistency_pa_sn=500.0,
            flow_index=0.35,
        ),
        Sealant(
            name="self_levelling",
            density_kg_m3=1350.0,
            yield_stress_pa=4.0,
            consistency_pa_sn=15.0,
            flow_index=0.80,
        ),
    )
}


def get_sealant(sealant: object) -> Sealant:
    """A sealant by name; one of the user's passes through.

    Args:
        sealant: A name or a ``Sealant``.

    Returns:
        The sealant.

    Raises:
        ConfigError: If there is no such name.
    """
    if isinstance(sealant, Sealant):
        return sealant
    if not isinstance(sealant, str) or sealant not in SEALANTS:
        raise ConfigError(f"sealant = {sealant!r}: must be one of {sorted(SEALANTS)} or a Sealant")
    return SEALANTS[sealant]


@dataclass(frozen=True, kw_only=True)
class GunCfg:
    """The pneumatic side of a sealing gun.

    Attributes:
        bore_m: Inner radius of the nozzle, a round tube [m].
        length_m: Length of the tube [m]; the cartridge before it is wide and costs no pressure.
        pressure_max_pa: Gauge pressure at an action of 1 [Pa]; an action of -1 is no pressure.
        lag_s: Time constant of valve and line [s].
    """

    bore_m: float = 1.2e-3
    length_m: float = 30e-3
    pressure_max_pa: float = 150e3
    lag_s: float = 0.08

    def __post_init__(self) -> None:
        """Checks the ranges."""
        highest = {"bore_m": 0.02, "length_m": 1.0, "pressure_max_pa": 2e6, "lag_s": 5.0}
        for f in fields(self):
            value, high = getattr(self, f.name), highest[f.name]
            positive = is_number(value) and (value > 0 or (f.name == "lag_s" and value == 0))
            require(
                positive and value <= high,
                f"GunCfg.{f.name} = {value!r}: must be a number above 0 and at most {high:g}; check the unit",
            )


def tube_flow(
    pressure_pa: ArrayLike,
    yield_stress_pa: ArrayLike,
    consistency_pa_sn: ArrayLike,
    flow_index: ArrayLike,
    gun: GunCfg,
) -> Array:
    """Steady laminar flow of a Herschel-Bulkley fluid through the nozzle.

    With the wall stress tau_w = p R / (2 L), phi = tau_y / tau_w and m = 1 / n:
    ``Q = pi R^3 (tau_w / K)^m (1 - phi)^(m + 1) [(1 - phi)^2 / (m + 3) + 2 phi (1 - phi) / (m + 2)
    + phi^2 / (m + 1)]``, the integral of the velocity profile over the section; Buckingham-Reiner at n = 1,
    Hagen-Poiseuille with tau_y = 0 as well.

    Args:
        pressure_pa: Gauge pressure at the nozzle's entry, shape (...), Pa.
        yield_stress_pa: tau_y, shape (...), Pa.
        consistency_pa_sn: K, shape (...), Pa s^n.
        flow_index: n, shape (...).
        gun: The nozzle.

    Returns:
        Shape (...), m^3/s; 0 where the wall stress is below the yield stress.
    """
    stress = np.maximum(np.asarray(pressure_pa, dtype=np.float64), 0.0) * (gun.bore_m / (2.0 * gun.length_m))
    m = 1.0 / np.asarray(flow_index, dtype=np.float64)
    phi = np.minimum(np.asarray(yield_stress_pa) / np.maximum(stress, 1e-12), 1.0)
    sheared = 1.0 - phi
    profile = sheared**2 / (m + 3.0) + 2.0 * phi * sheared / (m + 2.0) + phi**2 / (m + 1.0)
    rate = np.pi * gun.bore_m**3 * (stress / np.asarray(consistency_pa_sn)) ** m
    return np.asarray(rate * sheared ** (m + 1.0) * profile)


def pressure_for(flow_m3_s: ArrayLike, sealant: Sealant, gun: GunCfg) -> Array:
    """The pressure that gives a flow: the inverse of ``tube_flow``.

    Args:
        flow_m3_s: Wanted, shape (...), m^3/s.
        sealant: The fluid.
        gun: The nozzle.

    Returns:
        Shape (...), Pa; 0 where no flow is wanted, ``pressure_max_pa`` where the gun cannot give more.
    """
    wanted = np.asarray(flow_m3_s, dtype=np.float64)
    fluid = (sealant.yield_stress_pa, sealant.consistency_pa_sn, sealant.flow_index)
    low, high = np.zeros(wanted.shape), np.full(wanted.shape, gun.pressure_max_pa)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        short = tube_flow(middle, *fluid, gun) < wanted
        low, high = np.where(short, middle, low), np.where(short, high, middle)
        if np.all(high - low <= np.spacing(gun.pressure_max_pa)):
            break
    return np.where(wanted > 0.0, high, 0.0)


class PressureLine:
    """Valve and line of N guns: the pressure follows the command with a first-order lag.

    Attributes:
        pressure_pa: At the nozzles' entries, shape (N,), Pa.
        flow_m3_s: Flow at the end of the last step, shape (N,), m^3/s.
    """

    def __init__(self, n: int, gun: GunCfg) -> None:
        """Starts without pressure.

        Args:
            n: Number of guns.
            gun: Their nozzles and lines.
        """
        self._gun = gun
        self.pressure_pa = np.zeros(n)
        self.flow_m3_s = np.zeros(n)
        self._fluid = np.ones((3, n))

    def reset(self, i: int, sealant: Sealant) -> None:
        """Takes the pressure off one gun and fills it.

        Args:
            i: Which gun.
            sealant: What it holds from now on.
        """
        self.pressure_pa[i] = self.flow_m3_s[i] = 0.0
        self._fluid[:, i] = sealant.yield_stress_pa, sealant.consistency_pa_sn, sealant.flow_index

    def step(self, command_pa: Array, dt_s: float) -> Array:
        """Lets a constant command act for some time.

        Args:
            command_pa: Shape (N,), Pa; clipped to what the gun can hold.
            dt_s: How long [s].

        Returns:
            The volume that left each nozzle, shape (N,), m^3: the integral of the flow.
        """
        command = np.clip(command_pa, 0.0, self._gun.pressure_max_pa)
        gap = self.pressure_pa - command
        times = np.append(0.5 * dt_s * (1.0 + _NODES), dt_s)
        pressure = command + gap * self._left(times)[:, None]
        yield_stress, consistency, index = self._fluid
        flow = tube_flow(pressure, yield_stress, consistency, index, self._gun)
        self.pressure_pa, self.flow_m3_s = pressure[-1], flow[-1]
        return np.asarray(0.5 * dt_s * (_WEIGHTS[:, None] * flow[:-1]).sum(axis=0))

    def _left(self, times: Array) -> Array:
        """Share of the old difference that is left after some times."""
        if self._gun.lag_s == 0.0:
            return np.zeros_like(times)
        return np.asarray(np.exp(-times / self._gun.lag_s))
