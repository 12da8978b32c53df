"""Figures of control tables: sampled paths against truth, distributions of the RMSE, generalisation."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from experiments import shapes
from seal_gym.core.cell import load_cell
from seal_gym.core.frames import Array
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.seam import nearest_on_path
from seal_gym.workpieces.workpiece import Workpiece

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

Row = dict[str, Any]
Paths = Mapping[str, NDArray[np.float32]]
CLEARANCE_MM = 1.06  # of the nozzle's mouth to wall and plate
_BLUE, _GREY = "#1f5fa8", "#8a8f98"
COLOURS = {
    "adaptive": "#b8860b",
    "rmp_expert": "#6d7278",
    "neural_rmp": "#1f5fa8",
    "neural_control": "#d1382c",
    "neural_rmp_identity": "#2a9d54",
    "neural_rmp_dagger": "#5b9bd5",
    "neural_control_dagger": "#e8883a",
    "pid_servo": "#8e5bb5",
}
OTHER_COLOUR = "#444444"
plain = mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}")
_OUTCOMES = {
    "reached": ("o", "#2a9d54", "reached the end"),
    "collision": ("X", "#111111", "collision"),
    "lost": ("v", "#e8883a", "lost the seam"),
    "timeout": ("s", "#e8883a", "out of time"),
}


def path_name(row: Row) -> str:
    """Name of a trial's path in the file.

    Args:
        row: Of the trial.

    Returns:
        ``method/workpiece/seed``.
    """
    return f"{row['method']}/{row['workpiece']}/{row['seed']}"


def names(name: str, rows: Iterable[Row]) -> list[str]:
    """The files that ``draw`` writes.

    Args:
        name: Of the table.
        rows: Of the table.

    Returns:
        Names.
    """
    cells = [(row["table"], row["workpiece"]) for row in rows]
    out = [f"{name}_paths_{part}.png" for part in dict.fromkeys(p for table, p in cells if table == "main")]
    tables = {table for table, _ in cells}
    out += [f"{name}_rmse.png"] if "main" in tables else []
    return out + ([f"{name}_generalisation.png"] if "generalisation" in tables else [])


def draw(out: Path, document: Mapping[str, Any], paths: Paths) -> None:
    """Draws all figures.

    Args:
        out: The folder.
        document: With the table's ``name``, ``rows`` and ``trials``.
        paths: By ``path_name``, shape (samples, 3), mm.
    """
    rows, trials = document["rows"], document["trials"]
    by_path: dict[str, Row] = {}
    for t in trials:
        if path_name(t) in paths:
            # Paths are the shipped training seed's, whose trials stand before those of the others.
            by_path.setdefault(path_name(t), t)
    main, other = ([row for row in rows if row["table"] == name] for name in ("main", "generalisation"))
    table = document["name"]
    for name in names(table, rows):
        if name == f"{table}_rmse.png":
            draw_rmse(out / name, main, trials)
        elif name == f"{table}_generalisation.png":
            draw_generalisation(out / name, other, by_path, paths)
        else:
            draw_paths(out / name, name.removeprefix(f"{table}_paths_").removesuffix(".png"), by_path, paths)


def desired_path(part: str) -> tuple[Array, Array, float]:
    """Where the tip should go.

    Args:
        part: Name of a nominal part or a shape.

    Returns:
        Path in the part's frame with its run-on, shape (n, 3), mm; arc length of its points, shape (n,), mm;
        arc length of the end, mm. The sealed stretch is from 0 to there.
    """
    built: Workpiece = shapes.get(part).workpiece() if part in shapes.NAMES else catalogue.get(part)
    seam = built.seam
    return (
        1e3 * seam.tip_path(load_cell().process.stand_off_m),
        1e3 * seam.arc,
        1e3 * float(seam.length),
    )


def along_path(tip: Array, desired: Array, arc: Array) -> tuple[Array, Array]:
    """Where along a path each sample of another is, and how far off.

    Args:
        tip: Samples in order, shape (k, 3), mm.
        desired: The path, shape (n, 3), mm.
        arc: Arc length of its points, shape (n,), mm.

    Returns:
        Arc length of the nearest point, shape (k,), mm; the distance to it, shape (k,), mm.
    """
    found = [nearest_on_path(desired, arc, point, arc[0], arc[-1]) for point in np.asarray(tip, np.float64)]
    distance, s = np.array(found).T
    return s, distance


def _methods(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))


def draw_paths(path: Path, part: str, trials: Mapping[str, Row], paths: Paths) -> None:
    """Sampled paths of each method on a part: from the top, from the side, and their distance from the truth.

    Args:
        path: The PNG file.
        part: Name of the workpiece.
        trials: By ``path_name``.
        paths: By ``path_name``, mm.
    """
    here = {name: t for name, t in trials.items() if t["workpiece"] == part}
    methods = _methods(here.values())
    desired, arc, end = desired_path(part)
    sealed = desired[(arc >= -1e-6) & (arc <= end + 1e-6)]
    sealed_arc = arc[(arc >= -1e-6) & (arc <= end + 1e-6)]
    width, depth = np.ptp(sealed[:, :2], axis=0)
    thin = depth < 0.1 * width  # to scale it would be a line
    figure, grid = plt.subplots(
        3,
        len(methods),
        figsize=(max(2.9 * len(methods), 6.6), 9.2),
        squeeze=False,
        sharex="row",
        sharey="row",
        height_ratios=(1.5, 1, 1),
        constrained_layout=True,
    )
    for column, method in enumerate(methods):
        top, side, off = grid[:, column]
        top.plot(*sealed[:, :2].T, color=_BLUE, lw=5, alpha=0.3)
        side.plot(sealed_arc, sealed[:, 2], color=_BLUE, lw=5, alpha=0.3)
        mine = {name: t for name, t in here.items() if t["method"] == method}
        for name, trial in mine.items():
            tip = np.asarray(paths[name], dtype=np.float64)
            s, distance = along_path(tip, desired, arc)
            colour = COLOURS.get(method, OTHER_COLOUR)
            top.plot(*tip[:, :2].T, color=colour, lw=0.9)
            side.plot(s, tip[:, 2], color=colour, lw=0.9)
            off.semilogy(s, np.maximum(distance, 1e-3), color=colour, lw=0.9)
            marker, face, _ = _OUTCOMES[trial["outcome"]]
            for axes, x, y in (
                (top, tip[-1, 0], tip[-1, 1]),
                (side, s[-1], tip[-1, 2]),
                (off, s[-1], max(distance[-1], 1e-3)),
            ):
                axes.plot(x, y, marker, color=face, mec="white", mew=0.6, ms=7, zorder=5)
        off.axhline(CLEARANCE_MM, color=_GREY, ls="--", lw=1)
        off.yaxis.set_major_formatter(plain)
        reached = sum(t["reached"] for t in mine.values())
        top.set_title(f"{method}\n{reached} of these {len(mine)} reached the end", fontsize=10)
        if not thin:
            top.set_aspect("equal", adjustable="box")
        top.set_xlabel("x of the part [mm]")
        for axes in (side, off):
            axes.set_xlabel("along the seam [mm]")
        for axes in (top, side, off):
            axes.grid(color="#dddddd", lw=0.6)
    top, side, off = grid[:, 0]
    top.set_ylabel(f"from the top{' (stretched)' if thin else ''}: y of the part [mm]")
    side.set_ylabel("from the side: height [mm]")
    off.set_ylabel("distance from the desired path [mm]")
    off.text(0.02, CLEARANCE_MM, "nozzle clearance", color=_GREY, fontsize=8, va="bottom",
             transform=off.get_yaxis_transform())  # fmt: skip
    handles = [mpl.lines.Line2D([], [], color=_BLUE, lw=5, alpha=0.3, label="desired path")]
    handles.append(mpl.lines.Line2D([], [], color=OTHER_COLOUR, lw=1, label="tip, from its hover on"))
    for outcome in dict.fromkeys(t["outcome"] for t in here.values()):
        marker, face, label = _OUTCOMES[outcome]
        handles.append(mpl.lines.Line2D([], [], color=face, marker=marker, ls="", ms=7, label=label))
    seeds = sorted({t["seed"] for t in here.values()})
    figure.suptitle(f"{part}: paths of the tip, trial seeds {seeds[0]} to {seeds[-1]}")
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def draw_rmse(path: Path, rows: Sequence[Row], trials: Sequence[Row]) -> None:
    """The RMSE of every trial that reached, by part and method, and how many did.

    Args:
        path: The PNG file.
        rows: Of the main table.
        trials: All of the document's.
    """
    parts, methods = list(dict.fromkeys(row["workpiece"] for row in rows)), _methods(rows)
    figure, panels = plt.subplots(
        1,
        len(parts),
        figsize=(max(4.6 * len(parts), 6.4), 1.4 + 0.62 * len(methods)),
        sharex=True,
        sharey=True,
        squeeze=False,
        constrained_layout=True,
    )
    rng = np.random.default_rng(0)
    for axes, part in zip(panels[0], parts, strict=True):
        for y, method in enumerate(methods):
            (row,) = [r for r in rows if (r["method"], r["workpiece"]) == (method, part)]
            values = np.array(
                [
                    t["rmse_mm"]
                    for t in trials
                    if t["reached"]
                    and (t["method"], t["workpiece"], t["training_seed"])
                    == (method, part, row["training_seed"])
                ]
            )
            colour = COLOURS.get(method, OTHER_COLOUR)
            if len(values):
                scatter = y + 0.13 + 0.22 * rng.random(len(values))
                axes.plot(values, scatter, ".", color=colour, ms=4, alpha=0.6, mew=0)
                _box(axes, values, y - 0.12, colour)
            axes.text(
                0.985, y - 0.12, f"{len(values)} of {row['trials']}", transform=axes.get_yaxis_transform(),
                ha="right", va="center", fontsize=8, color="#333333",
            )  # fmt: skip
        axes.set(title=part, xlabel="RMSE [mm]")
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(plain)
        axes.xaxis.set_minor_formatter(mpl.ticker.NullFormatter())
        axes.text(
            0.985, -0.5, "reached", transform=axes.get_yaxis_transform(),
            ha="right", va="center", fontsize=8, color="#333333",
        )  # fmt: skip
        axes.grid(axis="x", which="both", color="#e3e3e3", lw=0.6)
    low, high = np.log10(panels[0, 0].get_xlim())
    low, high = np.floor(low), max(high, np.floor(low) + 1.0)
    panels[0, 0].set_xlim(10.0**low, 10.0 ** (high + 0.35 * (high - low)))  # room for the counts
    panels[0, 0].set_yticks(range(len(methods)), methods)
    panels[0, 0].set_ylim(len(methods) - 0.4, -0.6)
    figure.suptitle(
        "RMSE of the trials that reached the end: each trial, quartiles, median, 5th and 95th percentile"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _box(axes: Any, values: Array, y: float, colour: str) -> None:
    low, first, middle, third, high = np.percentile(values, (5, 25, 50, 75, 95))
    axes.plot((low, high), (y, y), color=colour, lw=1.2)
    axes.plot((first, third), (y, y), color=colour, lw=7, alpha=0.45, solid_capstyle="butt")
    axes.plot((middle,), (y,), "|", color=colour, ms=11, mew=2)


def draw_generalisation(path: Path, rows: Sequence[Row], trials: Mapping[str, Row], paths: Paths) -> None:
    """The shapes, with sampled paths of one method, beside each method's reached share and RMSE.

    Args:
        path: The PNG file.
        rows: Of the generalisation table.
        trials: By ``path_name``.
        paths: By ``path_name``, mm.
    """
    parts, methods = list(dict.fromkeys(row["workpiece"] for row in rows)), _methods(rows)
    drawn = "neural_rmp" if "neural_rmp" in methods else methods[0]
    cells = {(r["workpiece"], r["method"]): r for r in rows}
    figure = plt.figure(figsize=(8.4 + 1.9 * len(methods), 1.6 + 0.95 * len(parts)), constrained_layout=True)
    grid = figure.add_gridspec(len(parts), 3, width_ratios=(5.0, 0.6 + len(methods), 0.6 + len(methods)))
    for k, part in enumerate(parts):
        axes = figure.add_subplot(grid[k, 0])
        desired, arc, end = desired_path(part)
        sealed = desired[(arc >= -1e-6) & (arc <= end + 1e-6)]
        rise = part == "ramp"  # seen from the side: from the top it is a straight line
        across = 2 if rise else 1
        axes.plot(sealed[:, 0], sealed[:, across], color=_BLUE, lw=5, alpha=0.3)
        for name, trial in trials.items():
            if (trial["method"], trial["workpiece"]) == (drawn, part):
                marker, face, _ = _OUTCOMES[trial["outcome"]]
                axes.plot(*paths[name][:, [0, across]].T, color=COLOURS.get(drawn, OTHER_COLOUR), lw=0.8)
                axes.plot(*paths[name][-1, [0, across]], marker, color=face, ms=5, mec="white", mew=0.5)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_ylabel(
            f"{shapes.TITLES[part]}{' (side view)' if rise else ''}".replace(", ", ",\n"),
            rotation=0, ha="right", va="center", fontsize=9,
        )  # fmt: skip
        if k == 0:
            axes.set_title(f"shapes, and paths of {drawn}", fontsize=11)
    for column, (key, title, digits) in enumerate(
        (("reached_pct", "reached the end [%]", 0), ("rmse_mm", "RMSE of those that did [mm]", 3)), start=1
    ):
        values = np.array(
            [[np.nan if cells[p, m][key] is None else cells[p, m][key] for m in methods] for p in parts]
        )
        axes = figure.add_subplot(grid[:, column])
        _heat_map(axes, values, methods, digits, share=key == "reached_pct")
        axes.set_title(title, fontsize=11)
    trials_each = sorted({r["trials"] for r in rows})
    figure.suptitle(f"Seams of other shape, {' or '.join(map(str, trials_each))} trials each")
    figure.savefig(path, dpi=105)
    plt.close(figure)


def _heat_map(axes: Any, values: Array, columns: Sequence[str], digits: int, *, share: bool) -> None:
    """Cells with their numbers; dark is good for a share, bad for an error."""
    if share:
        scale: Any = mpl.colors.Normalize(0.0, 100.0)
    else:
        some = values[np.isfinite(values)]
        low, high = (float(some.min()), float(some.max())) if len(some) else (1e-2, 1.0)
        scale = mpl.colors.LogNorm(max(0.8 * low, 1e-4), max(1.5 * high, 1e-3))
    colours = mpl.colormaps["Blues" if share else "Oranges"].with_extremes(bad="#f2f2f2")
    axes.imshow(np.ma.masked_invalid(values), cmap=colours, norm=scale, aspect="auto", alpha=0.85)
    for (row, column), value in np.ndenumerate(values):
        text = f"{value:.{digits}f}" if np.isfinite(value) else "-"
        dark = np.isfinite(value) and scale(value) > 0.62
        axes.text(
            column, row, text, ha="center", va="center", fontsize=9, color="white" if dark else "#222222"
        )
    axes.set_xticks(range(len(columns)), [c.replace("_", "\n") for c in columns], fontsize=8)
    axes.set_yticks([])
    axes.tick_params(length=0)
