"""How hard the gun is pressed: constant, as Zhou et al. had it, or regulated by motion and the seen bead.

Zhou et al. (section 4.4): with a constant flow "the sealing gun deposits excess silicone sealant around the
corner"; they propose to reduce the pressure where the bead is seen to become thicker. The regulator does so
in two parts. Feed-forward: the wanted section times the speed of its centroid along the seam, by Pappus'
theorem the flow that fills it, in bends too; the nozzle's law gives the pressure, the line's lag is led.
Feedback: a slow integral of the bead's width behind the nozzle, because no cartridge is as thick as another.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents import Policy
from agents.reading import Reading, read
from seal_gym.core.cell import CellCfg
from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array
from seal_gym.envs.core import FEATURES
from seal_gym.sealant.config import SealantCfg
from seal_gym.sealant.pneumatics import pressure_for

_KPA, _MM = 1e3, 1e-3
_FLOWS = 400  # nodes of the table of pressures


@dataclass(frozen=True, kw_only=True)
class RegulatorCfg:
    """Gains of the pressure regulator.

    Attributes:
        near_m: The valve opens where the seam is this near to its place, in either view [m].
        width_m: Measured width of a bead of the wanted section [m].
        width_slope_m: Growth of the width with the section, relative [m].
        integral_s: Integral gain of the relative error of the section [1/s].
        most_trim: Largest factor on the flow, and the least its inverse.
        slow_m_s: Below this speed the bead behind the nozzle says nothing new [m/s].
        straight_rad_s: Above this turning rate the nozzle is in a bend [rad/s] ...
        settled_m: ... and so is the bead behind it for this much travel [m].
    """

    near_m: float = 5e-3
    width_m: float = 3.85e-3
    width_slope_m: float = 3.5e-3
    integral_s: float = 0.6
    most_trim: float = 3.0
    slow_m_s: float = 4e-3
    straight_rad_s: float = 0.3
    settled_m: float = 7e-3

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for f in fields(self):
            value = getattr(self, f.name)
            require(
                is_number(value) and value >= 0,
                f"RegulatorCfg.{f.name} = {value!r}: must be a number >= 0",
            )
        require(
            self.most_trim >= 1 and self.width_slope_m > 0,
            "RegulatorCfg: most_trim must be >= 1 and width_slope_m > 0",
        )


class Pressure(Protocol):
    """Gives the pressure channel of an action."""

    def __call__(self, now: Reading, sealant: Array, state: Array) -> Array:
        """Acts once.

        Args:
            now: What the cameras and the arm say.
            sealant: The sealant's rows of the observation, shape (N, 3).
            state: Of each run, changed in place, shape (N, 2).

        Returns:
            In [-1, 1], shape (N,).
        """


def _near(now: Reading, near_m: float) -> NDArray[np.bool_]:
    d_front, _, d_side, _, _ = now.errors
    return np.asarray(now.seen & (np.abs(d_front) < near_m) & (np.abs(d_side) < near_m))


class ConstantPressure:
    """Opens the valve when the nozzle has come to the seam and leaves it open.

    Args:
        cell: The cell: nominal speed.
        sealant: What is laid.
        cfg: When the valve opens.
    """

    def __init__(self, cell: CellCfg, sealant: SealantCfg, cfg: RegulatorCfg | None = None) -> None:
        self._cfg = cfg or RegulatorCfg()
        flow = 1e-6 * sealant.section_mm2 * cell.process.speed_m_s
        pressure = float(pressure_for(flow, sealant.fluid, sealant.gun))
        self._open = 2.0 * pressure / sealant.gun.pressure_max_pa - 1.0

    def __call__(self, now: Reading, sealant: Array, state: Array) -> Array:
        """See ``Pressure``."""
        del sealant
        state[:, 1] = np.maximum(state[:, 1], _near(now, self._cfg.near_m))
        return np.where(state[:, 1] > 0.0, self._open, -1.0)


class PressureRegulator:
    """Feed-forward by the centroid's speed, feedback by the bead's width.

    Args:
        cell: The cell: stand-off and frame rate.
        sealant: What is laid; its nominal parameters, not the cartridge's.
        cfg: Gains.
    """

    def __init__(self, cell: CellCfg, sealant: SealantCfg, cfg: RegulatorCfg | None = None) -> None:
        self._cfg, self._frame_s = cfg or RegulatorCfg(), cell.timing.frame_s
        self._section = 1e-6 * sealant.section_mm2
        # A filled right angle of height h has the section h^2 and its centroid at two thirds of h.
        self._arm = cell.process.stand_off_m - 2.0 / 3.0 * float(np.sqrt(self._section))
        gun = sealant.gun
        self._most, self._gain = gun.pressure_max_pa, 1.0
        if gun.lag_s > 0:
            self._gain = 1.0 / (1.0 - float(np.exp(-self._frame_s / gun.lag_s)))
        highest = 8.0 * self._section * cell.process.speed_m_s
        self._flows = np.linspace(0.0, np.sqrt(highest), _FLOWS) ** 2
        self._pressures = pressure_for(self._flows, sealant.fluid, gun)

    def __call__(self, now: Reading, sealant: Array, state: Array) -> Array:
        """See ``Pressure``."""
        cfg = self._cfg
        pressure, width, seen = _KPA * sealant[:, 0], _MM * sealant[:, 1], sealant[:, 2] > 0.5
        moving = now.twist - now.seam_twist
        speed = np.maximum(moving[:, 1] + moving[:, 3] * self._arm, 0.0)
        near = _near(now, cfg.near_m)
        turning = np.abs(moving[:, 5]) > cfg.straight_rad_s
        state[:, 1] = np.where(turning | ~near, 0.0, state[:, 1] + speed * self._frame_s)
        steady = near & seen & (speed > cfg.slow_m_s) & (state[:, 1] > cfg.settled_m)
        error = np.where(steady, (cfg.width_m - width) / cfg.width_slope_m, 0.0)
        limit = np.log(cfg.most_trim)
        state[:, 0] = np.clip(state[:, 0] + cfg.integral_s * self._frame_s * error, -limit, limit)
        flow = np.where(near, self._section * speed * np.exp(state[:, 0]), 0.0)
        wanted = np.interp(flow, self._flows, self._pressures)
        command = np.clip(pressure + self._gain * (wanted - pressure), 0.0, self._most)
        return np.asarray(2.0 * command / self._most - 1.0)


PRESSURES: dict[str, Callable[[CellCfg, SealantCfg], Pressure]] = {
    "regulated": PressureRegulator,
    "constant": ConstantPressure,
}


class WithPressure:
    """A policy of motion and one of pressure as a policy for environments with sealant.

    Args:
        motion: Moves the gun; sees the observation without the sealant's rows.
        pressure: Presses it.

    Attributes:
        control: The motion's.
    """

    def __init__(self, motion: Policy, pressure: Pressure) -> None:
        self.control = motion.control
        self._motion, self._pressure = motion, pressure

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Actions for observations, as Stable-Baselines3's policies give them.

        Args:
            observation: Of one environment or of N, with the sealant's rows.
            state: The motion's and the pressure's.
            episode_start: Rows whose episode has just begun.
            deterministic: Passed to the motion.

        Returns:
            The motion's actions and the pressure as one more channel, and the state.

        Raises:
            ConfigError: If the observation has no rows of the sealant.
        """
        features = observation["features"] if isinstance(observation, dict) else observation
        rows = np.atleast_2d(np.asarray(features, dtype=np.float64))
        require(
            rows.shape[1] == FEATURES + 3,
            f"observation has shape {np.shape(features)}: needs {FEATURES + 3} entries; make the environment "
            "with sealant=True",
        )
        moved = features[..., :FEATURES]
        seen = {**observation, "features": moved} if isinstance(observation, dict) else moved
        motion_state, own = (None, None) if state is None else state
        action, motion_state = self._motion.predict(seen, motion_state, episode_start, deterministic)
        own = np.zeros((len(rows), 2)) if own is None else own.copy()
        if episode_start is not None:
            own[np.broadcast_to(episode_start, len(rows))] = 0.0
        pressed = self._pressure(read(rows[:, :FEATURES].astype(np.float32)), rows[:, FEATURES:], own)
        together = np.concatenate((np.atleast_2d(action), pressed[:, None]), axis=1).astype(np.float32)
        return (together if np.ndim(features) == 2 else together[0]), (motion_state, own)


def with_pressure(motion: Policy, cell: CellCfg, sealant: SealantCfg, pressure: str) -> WithPressure:
    """Adds a pressure to a policy of motion.

    Args:
        motion: Moves the gun.
        cell: The cell.
        sealant: What is laid.
        pressure: A name in ``PRESSURES``.

    Returns:
        The policy.

    Raises:
        ConfigError: If there is no such pressure.
    """
    if pressure not in PRESSURES:
        raise ConfigError(f"pressure = {pressure!r}: must be one of {sorted(PRESSURES)}")
    return WithPressure(motion, PRESSURES[pressure](cell, sealant))
