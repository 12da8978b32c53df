"""The beads of N simulations on one strip: laid frame by frame, measured at any time."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.core.parallel import split
from seal_gym.sealant.config import SealantCfg
from seal_gym.sealant.deposition import REACH_M, lay
from seal_gym.sealant.levelling import level
from seal_gym.sealant.pneumatics import PressureLine, Sealant
from seal_gym.sealant.strip import Strip

_WINDOW_M = 14e-3
# A column counts as wet from this height on: thinner films neither seal nor show.
WET_M = 0.1e-3
# Less of the wanted section than this is a gap in the bead.
GAP_SHARE = 0.3
_BISECTIONS = 60


class BeadProfile(NamedTuple):
    """A bead along its seam, row by row of the strip.

    Attributes:
        arc: Arc length, shape (S,), m.
        section: Volume per arc length, shape (S,), m^2.
        wanted: The same of the wanted bead, shape (S,), m^2: larger outside a bend than on a straight.
        width: Across, between where it is ``WET_M`` high, shape (S,), m.
        height: Of the highest column, shape (S,), m.
    """

    arc: Array
    section: Array
    wanted: Array
    width: Array
    height: Array


@kernel
def _lay_rows(
    strip: Strip,
    volume: Array,
    height: Array,
    amount: Array,
    before: Array,
    tip: Array,
    turn: Array,
    fluid: Array,
    dt_s: float,
    missed: Array,
    window: NDArray[np.int64],
    first: int,
    last: int,
) -> None:
    spacing = strip.arc[1] - strip.arc[0]
    place = np.empty(3)
    most = int((2.0 * REACH_M / spacing + 3.0) ** 2)
    cells, at, gain = np.empty((most, 6)), np.empty((most, 2), np.int64), np.empty(most)
    for i in range(first, last):
        missed[i] = 0.0
        way = 0.0
        for a in range(3):
            way += (tip[i, a] - before[i, a]) ** 2
        # A fast tip leaves a line, not dots.
        pieces = int(np.sqrt(way) / spacing) + 1
        if amount[i] > 0.0:
            for p in range(pieces):
                for a in range(3):
                    place[a] = before[i, a] + (p + 1.0) / pieces * (tip[i, a] - before[i, a])
                missed[i] += lay(
                    strip,
                    volume[i],
                    height[i],
                    amount[i] / pieces,
                    place,
                    turn[i],
                    window[i, 0],
                    window[i, 1],
                    cells,
                    at,
                    gain,
                )
        level(
            strip,
            volume[i],
            height[i],
            dt_s,
            fluid[i, 0],
            fluid[i, 1],
            fluid[i, 2],
            fluid[i, 3],
            window[i, 0],
            window[i, 1],
        )


def wanted_heights(strip: Strip, section_m2: float, inside: NDArray[np.bool_]) -> Array:
    """The bead that is wanted: filled up to one level over the seam everywhere.

    Args:
        strip: The columns.
        section_m2: Its section where the seam is straight [m^2].
        inside: The sealed stretch, shape (S,).

    Returns:
        Heights of the columns, shape (S, U), m.
    """
    straight = np.argmin(np.abs(strip.spread[inside]).sum(axis=1) + np.ptp(strip.area[inside], axis=1))
    foot = strip.foot[inside][straight]
    pitch = strip.across[1] - strip.across[0]
    lowest = float(np.nanmin(foot))
    low, high = lowest, lowest + 50e-3
    # The filled region is the one round the seam: a groove's bead does not flood the plate beside it.
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if pitch * np.nansum(np.maximum(middle - foot, 0.0)) < section_m2:
            low = middle
        else:
            high = middle
    return np.asarray(np.nan_to_num(np.maximum(high - strip.foot, 0.0)))


class Bead:
    """N beads and the guns that lay them; rows never mix.

    Attributes:
        strip: The columns, in the part's frame.
        volume: Sealant in each column, shape (N, S, U), m^3.
        height: Of each column, shape (N, S, U), m.
        line: Valve, line and nozzle of each gun.
        used: What has left each nozzle since the reset, shape (N,), m^3.
        missed: What of it fell beside the columns, shape (N,), m^3.
    """

    def __init__(self, strip: Strip, length_m: float, n: int, cfg: SealantCfg) -> None:
        """Begins without sealant; ``reset`` every row before the first ``step``.

        Args:
            strip: The columns.
            length_m: Of the sealed stretch, which begins at arc length 0 [m].
            n: Number of simulations.
            cfg: Sealant, gun and the wanted bead.
        """
        self.strip, self.cfg = strip, cfg
        shape = (n, *strip.area.shape)
        self.volume, self.height = np.zeros(shape), np.zeros(shape)
        self.line = PressureLine(n, cfg.gun)
        self.used, self.missed = np.zeros(n), np.zeros(n)
        self._fluid = np.ones((n, 4))
        self._tip = np.zeros((n, 3))
        self._spacing = float(strip.arc[1] - strip.arc[0])
        self.inside = np.asarray((strip.arc >= 0.0) & (strip.arc <= length_m))
        wanted = strip.volume(wanted_heights(strip, 1e-6 * cfg.section_mm2, self.inside))
        self._wanted = wanted.sum(axis=1) / self._spacing

    def reset(self, i: int, tip: Array, rng: np.random.Generator) -> None:
        """Takes a bead away and fills its gun again.

        Args:
            i: Which simulation.
            tip: Position of the mouth in the part's frame, shape (3,), m.
            rng: Draws what the cartridge holds.
        """
        self.volume[i] = self.height[i] = 0.0
        self.used[i] = self.missed[i] = 0.0
        spread = 1.0 + self.cfg.variation * rng.uniform(-1.0, 1.0, 2)
        nominal = self.cfg.fluid
        fluid: Sealant = replace(
            nominal,
            yield_stress_pa=nominal.yield_stress_pa * spread[0],
            consistency_pa_sn=nominal.consistency_pa_sn * spread[1],
        )
        self.line.reset(i, fluid)
        self._fluid[i] = (
            fluid.density_kg_m3,
            fluid.yield_stress_pa,
            fluid.consistency_pa_sn,
            1.0 / fluid.flow_index,
        )
        self._tip[i] = tip

    def step(
        self, command_pa: Array, tip: Array, turn: Array, s: Array, dt_s: float, threads: int = 1
    ) -> None:
        """Lays one frame's sealant on the way to where the tips are now, and lets it level.

        Args:
            command_pa: Pressure asked for, shape (N,), Pa.
            tip: Positions of the mouths in the parts' frames, shape (N, 3), m.
            turn: ``R_part_tip``, shape (N, 3, 3).
            s: Arc lengths beside which the tips are, shape (N,), m.
            dt_s: Length of the frame [s].
            threads: Splits the batch; the beads are the same for any number.
        """
        amount = self.line.step(command_pa, dt_s)
        rows = len(self.strip.arc)
        # The two ends of the frame's way, whatever its length.
        reach = _WINDOW_M + np.sqrt(((tip - self._tip) ** 2).sum(axis=1))
        centre = (s - self.strip.arc[0]) / self._spacing
        window = np.stack((centre - reach / self._spacing, centre + reach / self._spacing + 1.0), axis=1)
        window = np.clip(window, 0, rows).astype(np.int64)
        missed = np.zeros(len(amount))

        def work(first: int, last: int) -> None:
            _lay_rows(
                self.strip,
                self.volume,
                self.height,
                amount,
                self._tip,
                tip,
                turn,
                self._fluid,
                dt_s,
                missed,
                window,
                first,
                last,
            )

        split(work, len(amount), threads)
        self.used += amount
        self.missed += missed
        self._tip[:] = tip

    def profile(self, i: int) -> BeadProfile:
        """One bead along its sealed stretch.

        Args:
            i: Which simulation.

        Returns:
            Section, width and height by arc length.
        """
        strip, rows = self.strip, self.inside
        return BeadProfile(
            arc=strip.arc[rows],
            section=self.volume[i, rows].sum(axis=1) / self._spacing,
            wanted=self._wanted[rows],
            width=np.array([self.width_at(i, int(row)) for row in np.flatnonzero(rows)]),
            height=self.height[i, rows].max(axis=1),
        )

    def width_at(self, i: int, row: int) -> float:
        """Width of one bead at one row of the strip: across, between where it is ``WET_M`` high.

        Args:
            i: Which simulation.
            row: Of the strip.

        Returns:
            Metres; 0 where it is dry.
        """
        height, across = self.height[i, row], self.strip.across
        wet = np.flatnonzero(height > WET_M)
        if not len(wet):
            return 0.0
        first, last = wet[0], wet[-1]
        ends = []
        for inner, outer in ((first, first - 1), (last, last + 1)):
            if not 0 <= outer < len(across):
                ends.append(across[inner])
                continue
            share = (height[inner] - WET_M) / (height[inner] - height[outer])
            ends.append(across[inner] + share * (across[outer] - across[inner]))
        return float(ends[1] - ends[0])

    def spine(self, i: int, step_m: float) -> tuple[Array, Array]:
        """A chain through the middle of one bead, for pictures.

        Args:
            i: Which simulation.
            step_m: Between its points [m].

        Returns:
            Points in the part's frame, shape (K, 3), m, and the radii of round sections of the bead's size,
            shape (K,), m; 0 where it is dry.
        """
        stride = max(round(step_m / self._spacing), 1)
        volume, height = self.volume[i, ::stride], self.height[i, ::stride]
        total = volume.sum(axis=1)
        share = np.divide(volume, total[:, None], out=np.zeros_like(volume), where=total[:, None] > 0)
        tops = self.strip.base[::stride] + 0.5 * height[..., None] * self.strip.column[::stride, None]
        return (share[..., None] * tops).sum(axis=1), np.sqrt(total / self._spacing / np.pi)

    def section_share(self, i: int, s: float, span_m: float) -> float:
        """How much of the wanted bead lies on a stretch of the seam.

        Args:
            i: Which simulation.
            s: Where the stretch ends [m].
            span_m: Its length [m].

        Returns:
            1 for as much as wanted; NaN before the sealed stretch.
        """
        arc = self.strip.arc
        rows = self.inside & (arc > s - span_m) & (arc <= s)
        if not rows.any():
            return float("nan")
        laid = self.volume[i, rows].sum() / self._spacing
        return float(laid / self._wanted[rows].sum())

    def metrics(self, i: int, corners: Array, corner_margin_m: float) -> dict[str, float]:
        """How good one bead is.

        Args:
            i: Which simulation.
            corners: Arc-length intervals of the seam's corners, shape (k, 2), m.
            corner_margin_m: What belongs to a corner before and after it [m].

        Returns:
            ``bead_mm3`` on the part, ``sealant_mm3`` that left the nozzle and ``missed_mm3`` of it beside the
            part; means ``bead_width_mm`` and ``bead_height_mm``; ``bead_section_pct``, the mean section, and
            ``bead_rmse_pct``, its root mean square departure, of the wanted one; ``gaps_pct`` of the arc;
            with corners ``corner_section_pct``, the mean section there.
        """
        p = self.profile(i)
        share = p.section / p.wanted
        out = {
            "bead_mm3": 1e9 * float(self.volume[i].sum()),
            "sealant_mm3": 1e9 * float(self.used[i]),
            "missed_mm3": 1e9 * float(self.missed[i]),
            "bead_width_mm": 1e3 * float(p.width.mean()),
            "bead_height_mm": 1e3 * float(p.height.mean()),
            "bead_section_pct": 100.0 * float(share.mean()),
            "bead_rmse_pct": 100.0 * float(np.sqrt(np.mean((share - 1.0) ** 2))),
            "gaps_pct": 100.0 * float(np.mean(share < GAP_SHARE)),
        }
        at_corner = np.zeros(len(p.arc), np.bool_)
        for low, high in corners:
            at_corner |= (p.arc >= low - corner_margin_m) & (p.arc <= high + corner_margin_m)
        if at_corner.any():
            out["corner_section_pct"] = 100.0 * float(share[at_corner].mean())
        return out
