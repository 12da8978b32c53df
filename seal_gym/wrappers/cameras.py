"""What goes wrong with the cameras: noise, lost frames, late frames, and a wrong hand-eye calibration."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import CellCfg
from seal_gym.core.frames import Array, axis_angle, normalise, transform
from seal_gym.wrappers.base import DisturbanceCfg, check_choice, check_numbers

LOST = ("black", "frozen")


@dataclass(frozen=True, kw_only=True)
class CameraNoiseCfg(DisturbanceCfg):
    """Grey noise besides the sensor's own, independent of it. Needs images.

    Attributes:
        sigma: Standard deviation at severity 1, of 255.
    """

    name: ClassVar[str] = "CameraNoise"

    sigma: float = 8.0

    def check(self) -> None:
        """Checks the range."""
        check_numbers(self, sigma=(0.0, 128.0))


@dataclass(frozen=True, kw_only=True)
class CameraDropoutCfg(DisturbanceCfg):
    """Frames of both cameras are lost, several in a row; never an episode's first.

    Attributes:
        share: Share of the frames that are lost at severity 1 (at most 0.95).
        in_a_row: Mean number of frames that are lost together, >= 1.
        lost: What comes in place of a lost frame: a ``"black"`` one or the last (``"frozen"``).
    """

    name: ClassVar[str] = "CameraDropout"

    share: float = 0.1
    in_a_row: float = 2.0
    lost: str = "black"

    def check(self) -> None:
        """Checks the ranges."""
        check_numbers(self, share=(0.0, 0.95), in_a_row=(1.0, 100.0))
        check_choice(self, "lost", LOST)


@dataclass(frozen=True, kw_only=True)
class CameraLatencyCfg(DisturbanceCfg):
    """Images come late, and perception is not told: it takes them for the present.

    Of a latency that is no whole number of frames, the rest is the chance that a frame is one frame later;
    an older frame never follows a newer one. Until the first frame of an episode is old enough it is shown.

    Attributes:
        frames: Latency at severity 1 [frames of 1/30 s].
    """

    name: ClassVar[str] = "CameraLatency"

    frames: float = 1.0

    def check(self) -> None:
        """Checks the range."""
        check_numbers(self, frames=(0.0, 30.0))


@dataclass(frozen=True, kw_only=True)
class HandEyeErrorCfg(DisturbanceCfg):
    """The cameras' bracket is not where the calibration says: off by a fixed length and angle.

    Both directions are random. The bracket turns about the point between the two cameras; the lamp on it
    turns as well. The nozzle is drawn where the calibration has it.

    Attributes:
        shift_mm: Displacement at severity 1 [mm].
        turn_deg: Rotation at severity 1 [deg].
    """

    name: ClassVar[str] = "HandEyeError"

    shift_mm: float = 0.2
    turn_deg: float = 0.1

    def check(self) -> None:
        """Checks the ranges."""
        check_numbers(self, shift_mm=(0.0, 20.0), turn_deg=(0.0, 10.0))


class HandEye:
    """Where the cameras of N simulations really are."""

    def __init__(self, n: int, cfg: HandEyeErrorCfg, cell: CellCfg) -> None:
        """Starts without error.

        Args:
            n: Number of simulations.
            cfg: The error.
            cell: The cameras.
        """
        self._cfg = cfg
        self._pivot = np.mean([c.position_m for c in cell.cameras], axis=0)
        self._error = np.tile(np.eye(4), (n, 1, 1))

    def reset(self, i: int, rng: np.random.Generator) -> None:
        """Draws one simulation's error.

        Args:
            i: Which simulation.
            rng: Source of the draws.
        """
        shift, axis = (normalise(v) for v in rng.standard_normal((2, 3)))
        severity = self._cfg.severity
        turn = axis_angle(axis, severity * float(np.deg2rad(self._cfg.turn_deg)))
        moved = severity * 1e-3 * self._cfg.shift_mm * shift
        self._error[i] = transform(turn, self._pivot - turn @ self._pivot + moved)

    def bracket(self, tip_pose: Array) -> Array:
        """Pose of a tip whose calibrated cameras would be where these really are.

        Args:
            tip_pose: ``T_base_tip``, shape (N, 4, 4), m.

        Returns:
            Shape (N, 4, 4), m.
        """
        return tip_pose @ self._error


class Feed:
    """The way from the cameras to perception for N simulations: frames are lost, then late.

    What goes through it are tuples of arrays with a row a simulation: images, or the lines that the oracle
    sees in their place; of both the same frames are lost and late.
    """

    def __init__(self, n: int, dropout: CameraDropoutCfg | None, latency: CameraLatencyCfg | None) -> None:
        """Starts empty.

        Args:
            n: Number of simulations.
            dropout: Frames to lose, if any.
            latency: Of the frames, if any.
        """
        share = min(dropout.severity * dropout.share, 0.95) if dropout else 0.0
        self._frozen = dropout is not None and dropout.lost == "frozen"
        # Two states, sending and lost: the mean stay in "lost" and the share of time in it fix the chances.
        self._recovers = 1.0 / dropout.in_a_row if dropout else 1.0
        self._fails = self._recovers * share / (1.0 - share)
        if self._fails > 1.0:  # so many are lost that they are lost longer in a row
            self._fails, self._recovers = 1.0, (1.0 - share) / share
        late = latency.severity * latency.frames if latency else 0.0
        self._late, self._later = int(late), late - int(late)
        self._depth = self._late + 2
        self._rngs: list[tuple[np.random.Generator, np.random.Generator] | None] = [None] * n
        self._frame = np.full(n, -1)
        self._lost = np.zeros(n, np.bool_)
        self._shown = np.zeros(n, np.int64)
        self._kept: dict[str, list[NDArray[Any]]] = {}
        self._taken: dict[str, NDArray[np.int64]] = {}

    def reset(self, i: int, dropout: np.random.Generator, latency: np.random.Generator) -> None:
        """Forgets one simulation's frames.

        Args:
            i: Which simulation.
            dropout: Draws the lost frames.
            latency: Draws the late ones.
        """
        self._rngs[i] = dropout, latency
        self._frame[i], self._lost[i], self._shown[i] = -1, False, 0
        for taken in self._taken.values():
            taken[i] = -1

    def expose(self, frame: NDArray[np.int64]) -> None:
        """Decides the fate of a frame, once for each.

        Args:
            frame: Number of the frame in its episode, shape (N,).
        """
        for i in map(int, np.flatnonzero(frame != self._frame)):
            rngs, k = self._rngs[i], int(frame[i])
            assert rngs is not None, "every row is reset before it looks"
            fate, jitter = rngs[0].random(), rngs[1].random()
            self._lost[i] = k > 0 and fate < (1.0 - self._recovers if self._lost[i] else self._fails)
            late = self._late + (jitter < self._later)
            self._shown[i] = max(k - late, self._shown[i], 0)
        self._frame = frame.copy()

    def __call__(self, what: str, new: tuple[NDArray[Any], ...]) -> tuple[NDArray[Any], ...]:
        """Takes in the frame that was exposed and gives the one that arrives.

        Args:
            what: Name of the stream.
            new: Its arrays, shape (N, ...) each.

        Returns:
            Arrays of the caller's own.
        """
        if what not in self._kept:
            self._kept[what] = [np.zeros((self._depth, *x.shape), x.dtype) for x in new]
            self._taken[what] = np.full(len(self._frame), -1)
        rows = np.flatnonzero(self._frame != self._taken[what])
        self._taken[what] = self._frame.copy()
        slot, before = self._frame[rows] % self._depth, (self._frame[rows] - 1) % self._depth
        out = []
        for kept, x in zip(self._kept[what], new, strict=True):
            kept[slot, rows] = x[rows]
            lost = self._lost[rows]
            kept[slot[lost], rows[lost]] = kept[before[lost], rows[lost]] if self._frozen else 0
            out.append(kept[self._shown % self._depth, np.arange(len(x))])
        return tuple(out)
