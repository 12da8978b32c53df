"""Figures of simulated laydown."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from seal_gym.sealant.laydown.sections import BELOW_M, COLUMNS, PIXEL_M, ROWS

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

_STYLE = {"interFoam": "-", "interIsoFoam": "--"}
_MM = 1e3 * PIXEL_M


def grid(path: Path, rows: list[dict[str, Any]]) -> None:
    """The grid study: thickness across each bead, and the sections.

    Args:
        path: The PNG file.
        rows: Of the study, with their mean ``section``.
    """
    sizes = sorted({r["cell_mm"] for r in rows})
    colours = dict(zip(sizes, mpl.colormaps["viridis"](np.linspace(0.0, 0.85, len(sizes))), strict=True))
    x = (np.arange(COLUMNS) + 0.5 - COLUMNS / 2) * _MM
    lines = -(-len(rows) // 4)
    figure = plt.figure(figsize=(13, 4.2 + 2.0 * lines), constrained_layout=True)
    halves: Any = figure.subfigures(2, 1, height_ratios=(4.2, 2.0 * lines))
    upper, lower = halves
    profile = upper.subplots()
    for r in rows:
        thick = np.array(r["section"]).sum(0) * _MM
        label = f"{r['solver']}, {r['cell_mm']:g} mm"
        profile.plot(x, thick, _STYLE[r["solver"]], color=colours[r["cell_mm"]], label=label)
    profile.set(xlabel="across [mm]", ylabel="thickness [mm]")
    profile.grid(color="#dddddd", lw=0.6)
    profile.legend(fontsize=8)
    extent = (-COLUMNS / 2 * _MM, COLUMNS / 2 * _MM, -1e3 * BELOW_M, ROWS * _MM - 1e3 * BELOW_M)
    spots = lower.subplots(lines, 4, sharex=True, sharey=True, squeeze=False)
    for axes, r in zip(spots.flat, rows, strict=False):
        axes.imshow(np.array(r["section"]), origin="lower", extent=extent, cmap="Greys", vmin=0, vmax=1)
        axes.axhline(0.0, color="#d1382c", lw=0.8)
        axes.set(ylim=(-3, 6))
        axes.set_title(f"{r['solver']}, {r['cell_mm']:g} mm", fontsize=9)
    for axes in spots[-1]:
        axes.set_xlabel("across [mm]")
    for axes in spots[:, 0]:
        axes.set_ylabel("height [mm]")
    for axes in spots.flat[len(rows) :]:
        axes.set_axis_off()
    figure.savefig(path, dpi=110)
    plt.close(figure)
