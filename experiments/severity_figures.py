"""Charts of reached and RMSE against severity: one a disturbance, and one page with all."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from experiments.control_figures import CLEARANCE_MM, COLOURS, OTHER_COLOUR, plain
from experiments.severity_report import at_one

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

Row = dict[str, Any]
_ACROSS = 3  # charts side by side on the page
_MARKERS = "osDv^P*X"
_DODGE = 0.05  # of severity, from one method to the next: they often lie on each other
_FEW = 50.0  # percent; an RMSE over fewer is that of the lucky ones


def _disturbances(rows: Iterable[Row]) -> list[str]:
    return [name for name in dict.fromkeys(row["disturbance"] for row in rows) if name is not None]


def names(name: str, rows: Iterable[Row]) -> list[str]:
    """The files that ``draw`` writes.

    Args:
        name: Of the experiment.
        rows: From ``severity_report.summarise``.

    Returns:
        Names: the page, then one a disturbance; none without disturbances.
    """
    found = _disturbances(rows)
    return [f"{name}.png", *(f"{name}_{one}.png" for one in found)] if found else []


def draw(out: Path, document: Mapping[str, Any]) -> None:
    """Draws all charts.

    Args:
        out: The folder.
        document: With ``name`` and ``rows``.
    """
    rows = document["rows"]
    files = names(document["name"], rows)
    if not files:
        return
    draw_page(out / files[0], rows)
    for file, one in zip(files[1:], _disturbances(rows), strict=True):
        draw_one(out / file, one, rows)


def draw_page(path: Path, rows: Sequence[Row]) -> None:
    """All disturbances: the reached share, and below it the RMSE, on the same scales.

    Args:
        path: The PNG file.
        rows: From ``severity_report.summarise``.
    """
    found = _disturbances(rows)
    across = min(_ACROSS, len(found))
    down = -(-len(found) // across)
    figure = plt.figure(figsize=(max(4.4 * across, 7.0), 4.6 * down + 0.9), constrained_layout=True)
    boxes = np.atleast_2d(figure.subfigures(down, across, squeeze=False))
    span = _rmse_span(rows)
    for k, (box, one) in enumerate(zip(boxes.flat, found, strict=False)):
        above, below = box.subplots(2, 1, sharex=True)
        _reached(above, one, rows)
        _rmse(below, one, rows)
        below.set_ylim(*span)
        above.set_title(one, fontsize=11, fontweight="bold", pad=20)
        above.text(
            0.5, 1.03, f"1: {at_one(one)}", transform=above.transAxes, ha="center", va="bottom",
            fontsize=7.5, color="#444444",
        )  # fmt: skip
        below.set_xlabel("severity")
        if k % across == 0:
            above.set_ylabel("reached the end [%]")
            below.set_ylabel("RMSE of those [mm]")
    figure.suptitle(_title(rows))
    _legend(figure, rows)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def draw_one(path: Path, disturbance: str, rows: Sequence[Row]) -> None:
    """One disturbance: the reached share beside the RMSE.

    Args:
        path: The PNG file.
        disturbance: Its name.
        rows: From ``severity_report.summarise``.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 4.9), constrained_layout=True)
    _reached(left, disturbance, rows)
    _rmse(right, disturbance, rows)
    right.set_ylim(*_rmse_span([r for r in rows if r["disturbance"] == disturbance]))
    left.set_title("reached the end [%]", fontsize=11)
    right.set_title("RMSE of those that did [mm]", fontsize=11)
    for axes in (left, right):
        axes.set_xlabel(f"severity (1: {at_one(disturbance)})", fontsize=8.5)
    figure.suptitle(f"{disturbance}: {_title(rows)}")
    _legend(figure, rows)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _title(rows: Sequence[Row]) -> str:
    return f"{rows[0]['workpiece']}, {rows[0]['trials']} trials a point, with 95 % intervals"


def _methods(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))


def _look(method: str, rows: Sequence[Row]) -> tuple[str, str, float]:
    """Colour, marker and shift in severity of a method."""
    all_methods = _methods(rows)
    k = all_methods.index(method)
    shift = _DODGE * (k - (len(all_methods) - 1) / 2)
    return COLOURS.get(method, OTHER_COLOUR), _MARKERS[k % len(_MARKERS)], shift


def _reached(axes: Any, disturbance: str, rows: Sequence[Row]) -> None:
    _curves(axes, disturbance, rows, "reached_pct", "reached_ci")
    axes.set_ylim(-4, 104)
    axes.set_yticks(range(0, 101, 25))


def _rmse(axes: Any, disturbance: str, rows: Sequence[Row]) -> None:
    _curves(axes, disturbance, rows, "rmse_mm", "rmse_mm_ci")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(plain)
    axes.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    axes.axhline(CLEARANCE_MM, color="#8a8f98", ls="--", lw=1)
    axes.text(
        0.98, CLEARANCE_MM, "nozzle clearance", color="#6d7278", fontsize=7.5, ha="right", va="bottom",
        transform=axes.get_yaxis_transform(),
    )  # fmt: skip


def _curves(axes: Any, disturbance: str, rows: Sequence[Row], key: str, interval: str) -> None:
    for method in _methods(rows):
        colour, marker, shift = _look(method, rows)
        mine = [
            r for r in rows if (r["disturbance"], r["method"]) == (disturbance, method) and r[key] is not None
        ]
        x = [r["severity"] + shift for r in mine]
        axes.plot(x, [r[key] for r in mine], color=colour, lw=1.5)
        for at, row in zip(x, mine, strict=True):
            few = key == "rmse_mm" and row["reached_pct"] < _FEW
            face = "white" if few else colour
            axes.plot(at, row[key], marker, mfc=face, mec=colour, ms=5.5, zorder=3)
            if row[interval] is not None:
                axes.plot((at, at), row[interval], color=colour, lw=1, alpha=0.7)
    axes.set_xticks(sorted({r["severity"] for r in rows}))
    axes.xaxis.set_major_formatter(plain)
    axes.grid(color="#e3e3e3", lw=0.6)


def _rmse_span(rows: Iterable[Row]) -> tuple[float, float]:
    """Whole decades that hold all RMSE."""
    values = [r["rmse_mm"] for r in rows if r["rmse_mm"] is not None]
    low, high = (min(values), max(*values, CLEARANCE_MM)) if values else (0.1, CLEARANCE_MM)
    return 10.0 ** np.floor(np.log10(0.9 * low)), 10.0 ** np.ceil(np.log10(1.1 * high))


def _legend(figure: Any, rows: Sequence[Row]) -> None:
    handles = []
    for method in _methods(rows):
        colour, marker, _ = _look(method, rows)
        handles.append(mpl.lines.Line2D([], [], color=colour, marker=marker, ms=5.5, label=method))
    handles.append(
        mpl.lines.Line2D(
            [], [], color="#444444", marker="o", mfc="white", ls="", ms=5.5,
            label="RMSE where fewer than half reached the end",
        )
    )  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 5), fontsize=9)
