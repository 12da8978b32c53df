"""Figures of refined bead paths: heights at both edges in the reference, and the corrections."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from seal_gym.core.frames import Array
from seal_gym.planning.bead_cases import BeadCase

mpl.use("Agg")
import matplotlib.pyplot as plt  # the backend has to be chosen first

_LEFT, _RIGHT, _CORNER = "#0072b2", "#d55e00", "#eeeeee"
_COLOURS = ("k", "#009e73", "#cc79a7")
_UNITS = (
    (0, "speed [%]", 100.0),
    (1, "shift [mm]", 1e3),
    (2, "offset [mm]", 1e3),
    (3, "tilt [deg]", 180 / np.pi),
)


def draw(file: Path, case: BeadCase, names: Sequence[str], stored: dict[str, Array]) -> None:
    """Draws a case.

    Args:
        file: To write.
        case: For the title.
        names: Of the paths.
        stored: ``along`` and ``corner`` (n,), ``truth`` and ``asked`` (paths, 2, n), ``corrections``
            (paths, m, 5), ``share`` (m,).
    """
    figure = plt.figure(figsize=(14.0, 7.0), layout="constrained")
    parts: Any = figure.subfigures(1, 2, width_ratios=(1.7, 1.0))
    s, truth, asked = 1e3 * stored["along"], 1e3 * stored["truth"], 1e3 * stored["asked"]
    spans = np.flatnonzero(np.diff(np.concatenate(([0], stored["corner"].astype(int), [0])))).reshape(-1, 2)
    axes = parts[0].subplots(len(names), 1, sharex=True, sharey=True)
    for ax, name, found, model in zip(axes, names, truth, asked, strict=True):
        for k, (first, last) in enumerate(spans):
            ax.axvspan(s[first], s[last - 1], color=_CORNER, lw=0, label=None if k else "corner")
        ax.plot(s, found[0], color=_LEFT, lw=1.6, label="left edge")
        ax.plot(s, found[1], color=_RIGHT, lw=1.6, label="right edge")
        ax.plot(s, model[0], color="k", lw=0.9, ls=":", label="by its evaluator")
        ax.plot(s, model[1], color="k", lw=0.9, ls=":")
        ax.set_title(f"{name}: {100 * found.std() / found.mean():.1f} % uneven", fontsize=11)
        ax.set_ylabel("height [mm]")
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("along the centre line [mm]")
    handles, labels = axes[0].get_legend_handles_labels()
    parts[0].legend(handles, labels, loc="outside lower center", ncols=len(labels))
    parts[0].suptitle("Laid by the reference", fontsize=12)
    axes = parts[1].subplots(len(_UNITS), 1, sharex=True)
    for ax, (channel, label, unit) in zip(axes, _UNITS, strict=True):
        for name, colour, values in zip(names[1:], _COLOURS[1:], stored["corrections"][1:], strict=True):
            ax.plot(100 * stored["share"], unit * values[:, channel], color=colour, lw=1.4, label=name)
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("share of the nozzle's way [%]")
    parts[1].legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    parts[1].suptitle("Corrections of the geometric path", fontsize=12)
    figure.suptitle(f"Refined bead path: {case.title}", fontsize=13)
    figure.savefig(file, dpi=80)
    plt.close(figure)
