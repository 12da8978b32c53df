"""The sealant of N sealing cells: pressure in, bead out, and what the side view shows of it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.envs.config import SealCfg
from seal_gym.sealant.bead import Bead
from seal_gym.sealant.config import SealantCfg
from seal_gym.sim.bead_strip import bead_strip
from seal_gym.sim.raycast_bead import BeadView
from seal_gym.sim.scene import Scene
from seal_gym.vision.fresh_bead import BEHIND_M, BeadGauge, BeadWidth

_MM = 1e3
# Name, scale from SI, bound after scaling: rows that sealant adds to the observation.
ROWS = (("pressure_kpa", 1e-3, 2000.0), ("bead_width_mm", _MM, 50.0), ("bead_seen", 1.0, 1.0))
# The stretch behind the tip on which the bead is judged: beyond the paste round the mouth.
_JUDGED_M = (3e-3, 4e-3)
_IN_VIEW_M = (12e-3, 26e-3)
_CORNER_MARGIN_M = 3e-3


class Extrusion:
    """Guns and beads of N simulations.

    Attributes:
        cfg: Sealant, gun and the wanted bead.
        bead: What lies on the parts.
        width: The bead behind each nozzle as the side view showed it last.
    """

    def __init__(self, cfg: SealCfg, sealant: SealantCfg, scene: Scene, n: int) -> None:
        """Lays out the columns over the part.

        Args:
            cfg: The environment's.
            sealant: The sealant's.
            scene: The compiled scene.
            n: Number of simulations.
        """
        self.cfg = sealant
        self._threads, self._dt = cfg.threads, cfg.cell.timing.frame_s
        self._seam = scene.workpiece.seam
        strip = bead_strip(scene.workpiece, sealant.spacing_m, sealant.half_width_m)
        self.bead = Bead(strip, self._seam.length, n, sealant)
        self.width = BeadWidth(np.zeros(n), np.zeros(n, np.bool_))
        self._gauge: BeadGauge | None = None
        self._camera = cfg.cell.cameras[1]
        self._s = np.zeros(n)

    def watch(self, nozzle: Array) -> None:
        """Measures beads in the side views from now on, instead of on the part.

        Args:
            nozzle: The nozzle's coverage of their pixels, shape (height, width).
        """
        self._gauge = BeadGauge(self._camera, nozzle, self.cfg.fluid.rgb)

    def reset(self, i: int, tip: Array, s: float, rng: np.random.Generator) -> None:
        """Takes one bead away and fills its gun.

        Args:
            i: Which simulation.
            tip: Position of the mouth in the part's frame, shape (3,), m.
            s: Arc length beside which it is [m].
            rng: Draws what the cartridge holds.
        """
        self.bead.reset(i, tip, rng)
        self.width.width_m[i], self.width.seen[i] = 0.0, False
        self._s[i] = s

    def step(self, action: Array, tip: Array, turn: Array, s: Array) -> None:
        """Lays one frame's sealant.

        Args:
            action: Pressure channel in [-1, 1]: none to ``pressure_max_pa``, shape (N,).
            tip: Positions of the mouths in the parts' frames, shape (N, 3), m.
            turn: ``R_part_tip``, shape (N, 3, 3).
            s: Arc lengths beside which they are, shape (N,), m.
        """
        command = 0.5 * (action + 1.0) * self.cfg.gun.pressure_max_pa
        self.bead.step(command, tip, np.ascontiguousarray(turn), s, self._dt, self._threads)
        self._s = s.copy()

    def reward(self) -> Array:
        """The bead's term of the reward: -``SealantCfg.reward`` times its relative error behind the tip.

        The error is |section / wanted - 1|, at most 1.

        Returns:
            Shape (N,).
        """
        if self.cfg.reward == 0.0:
            return np.zeros(len(self._s))
        off = np.array([abs(self.share(i) - 1.0) for i in range(len(self._s))])
        return np.asarray(-self.cfg.reward * np.minimum(np.nan_to_num(off), 1.0))

    def share(self, i: int) -> float:
        """Section of the bead just behind one tip, relative to the wanted one; NaN before the seam's start.

        Args:
            i: Which simulation.

        Returns:
            1 for as much as wanted.
        """
        behind, span = _JUDGED_M
        return self.bead.section_share(i, float(self._s[i]) - behind, span)

    def look(self, side: NDArray[np.uint8] | None, rows: NDArray[np.bool_] | None) -> None:
        """Measures the beads behind the tips, in the images if ``watch`` was called.

        Args:
            side: Side views, shape (N, height, width, 3); None without images.
            rows: Simulations that look, shape (N,), all by default.
        """
        if self._gauge is not None and side is not None:
            new = self._gauge.measure(side)
        else:
            new = self._true_width()
        every = np.ones(len(self._s), np.bool_) if rows is None else rows
        self.width = BeadWidth(
            np.where(every, new.width_m, self.width.width_m), np.where(every, new.seen, self.width.seen)
        )

    def _true_width(self) -> BeadWidth:
        """What an ideal camera would measure: the wet columns' extent where the gauge looks."""
        bead, at = self.bead, self._s - 0.5 * sum(BEHIND_M)
        k = np.clip(np.searchsorted(bead.strip.arc, at), 0, len(bead.strip.arc) - 1)
        width = np.array([bead.width_at(i, int(row)) for i, row in enumerate(k)])
        return BeadWidth(width, width > 0.0)

    def rows(self) -> Array:
        """The observation's rows, see ``ROWS``.

        Returns:
            Shape (N, 3).
        """
        values = (self.bead.line.pressure_pa, self.width.width_m, self.width.seen)
        scaled = [
            np.minimum(s * np.asarray(v, np.float64), bound)
            for (_, s, bound), v in zip(ROWS, values, strict=True)
        ]
        return np.stack(scaled, axis=1)

    def view(self) -> BeadView:
        """What the sensor cameras see of the beads.

        Returns:
            For the raycaster.
        """
        bead, (behind, ahead) = self.bead, _IN_VIEW_M
        arc = bead.strip.arc
        ends = (np.searchsorted(arc, self._s - behind), np.searchsorted(arc, self._s + ahead))
        window = np.stack(ends, axis=1)
        return BeadView(bead.strip, bead.height, window.astype(np.int64), np.array(self.cfg.fluid.rgb))

    def metrics(self, i: int) -> dict[str, float]:
        """How good one bead is, see ``Bead.metrics``.

        Args:
            i: Which simulation.

        Returns:
            Metrics by name.
        """
        return self.bead.metrics(i, self._seam.corners, _CORNER_MARGIN_M)

    def info(self, i: int) -> dict[str, Any]:
        """What the info says of one gun and its bead.

        Args:
            i: Which simulation.

        Returns:
            ``pressure_kpa`` and ``flow_mm3_s`` at the nozzle; ``bead_width_mm`` and ``bead_seen`` as
            observed; ``bead_section_pct``: the true section behind the tip, relative to the wanted one (NaN
            before the seam's start), for metrics, not for policies.
        """
        line = self.bead.line
        return {
            "pressure_kpa": float(1e-3 * line.pressure_pa[i]),
            "flow_mm3_s": float(1e9 * line.flow_m3_s[i]),
            "bead_width_mm": float(_MM * self.width.width_m[i]),
            "bead_seen": bool(self.width.seen[i]),
            "bead_section_pct": 100.0 * self.share(i),
        }

    def infos(self) -> dict[str, NDArray[Any]]:
        """``info`` of all simulations at once.

        Returns:
            Shape (N,) each.
        """
        rows = [self.info(i) for i in range(len(self._s))]
        return {name: np.array([row[name] for row in rows]) for name in rows[0]}
