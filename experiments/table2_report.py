"""Table 2's rows, Markdown and chart, from each trial's sums of squared errors."""

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np

from seal_gym.core.cell import VIEWS
from seal_gym.core.frames import Array
from seal_gym.workpieces import catalogue

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

# Name and unit: in the image as Zhou et al. measure them, and in the tip frame.
FEATURES = (("d_attr", "px"), ("theta", "deg"), ("d_tip", "mm"), ("theta_tip", "deg"))
REGIONS = ("straight", "corner")
# Without -> with Kalman, units unstated (Zhou et al., Table 2).
PAPER = {
    ("flat", "front", "d_attr"): (2.52, 0.78),
    ("flat", "front", "theta"): (1.63, 0.56),
    ("flat", "side", "d_attr"): (2.66, 0.66),
    ("flat", "side", "theta"): (1.57, 0.61),
    ("cylinder", "front", "d_attr"): (3.08, 0.88),
    ("cylinder", "front", "theta"): (2.59, 0.73),
    ("cylinder", "side", "d_attr"): (3.14, 0.85),
    ("cylinder", "side", "theta"): (2.41, 0.81),
    ("rectangular", "front", "d_attr"): (3.69, 0.94),
    ("rectangular", "front", "theta"): (2.92, 0.97),
    ("rectangular", "side", "d_attr"): (3.93, 0.99),
    ("rectangular", "side", "theta"): (3.05, 1.05),
}


class Method(NamedTuple):
    """A way of reading the images.

    Attributes:
        edge: Name of the edge method.
        tracker: ``none``, ``kalman`` or ``memory``.
        refined: Whether the edge is found to a fraction of a pixel and fitted by a curve at the tip.
    """

    edge: str
    tracker: str
    refined: bool

    @property
    def name(self) -> str:
        """For files."""
        return f"{self.edge}-{'refined' if self.refined else 'raw'}-{self.tracker}"


def rmse_interval(squared: Array, lines: Array) -> tuple[float, float] | None:
    """Bootstrap 95 % interval over trials of the RMSE of all frames (percentile method, fixed seed).

    Args:
        squared: Sum of squared errors of each trial, shape (n,).
        lines: Number of errors of each, shape (n,).

    Returns:
        Lower and upper end; None with fewer than two trials that have any.
    """
    squared, lines = squared[lines > 0], lines[lines > 0]
    if len(lines) < 2:
        return None
    draw = np.random.default_rng(0).integers(0, len(lines), (2000, len(lines)))
    low, high = np.percentile(np.sqrt(squared[draw].sum(axis=1) / lines[draw].sum(axis=1)), (2.5, 97.5))
    return float(low), float(high)


def _cell(rows: list[dict[str, Any]], name: str, regions: list[str]) -> dict[str, Array]:
    """Sums of each trial over regions, shape (trials, 2, 4)."""
    return {
        key: np.array([np.sum([t["sums"][name][r][key] for r in regions], axis=0) for t in rows])
        for key in ("squared", "lines", "frames")
    }


def summarise(rows: list[dict[str, Any]], methods: list[Method]) -> list[dict[str, Any]]:
    """The table's rows.

    Args:
        rows: Of ``table2.run``.
        methods: Those that read the images.

    Returns:
        One for each part, region, method, view and feature; a part without corners has only ``all``.
    """
    out = []
    for part in dict.fromkeys(t["workpiece"] for t in rows):
        cell = [t for t in rows if t["workpiece"] == part]
        regions = {"all": list(REGIONS)}
        if len(catalogue.get(part).seam.corners):
            regions |= {r: [r] for r in REGIONS}
        for region, parts in regions.items():
            for method in methods:
                sums = _cell(cell, method.name, parts)
                for v, view in enumerate(VIEWS):
                    for k, (feature, unit) in enumerate(FEATURES):
                        squared, lines, frames = (
                            sums[key][:, v, k] for key in ("squared", "lines", "frames")
                        )
                        count = lines.sum()
                        out.append(
                            {
                                "workpiece": part,
                                "view": view,
                                "feature": feature,
                                "region": region,
                                "edge": method.edge,
                                "refined": method.refined,
                                "tracker": method.tracker,
                                "kalman": method.tracker != "none",
                                "rmse": float(np.sqrt(squared.sum() / count)) if count else None,
                                "unit": unit,
                                "rmse_ci": rmse_interval(squared, lines),
                                "availability_pct": float(100.0 * count / max(frames.sum(), 1)),
                                "trials": len(cell),
                                "seed0": min(t["seed"] for t in cell),
                            }
                        )
    return out


def _key(row: dict[str, Any]) -> tuple[str, ...]:
    return row["workpiece"], row["region"], row["edge"], str(row["refined"]), row["tracker"]


def _label(row: dict[str, Any]) -> list[str]:
    return [row["edge"], "refined" if row["refined"] else "raw", row["tracker"]]


def _figure(row: dict[str, Any]) -> str:
    if row["rmse"] is None:
        return "-"
    if row["rmse_ci"] is None:
        return f"{row['rmse']:.2f}"
    return f"{row['rmse']:.2f} [{row['rmse_ci'][0]:.2f}, {row['rmse_ci'][1]:.2f}]"


_COLUMNS = [(view, feature, unit) for view in VIEWS for feature, unit in FEATURES[:2]]
_TIP_COLUMNS = [(view, feature, unit) for view in VIEWS for feature, unit in FEATURES[2:]]


def _paper(part: str) -> list[list[str]]:
    return [
        [
            "*Zhou et al., units unstated*",
            "",
            tracker,
            *(f"{PAPER[part, view, feature][k]:.2f}" for view, feature, _ in _COLUMNS),
            *[""] * (1 + len(_TIP_COLUMNS)),
        ]
        for k, tracker in enumerate(("none", "kalman"))
    ]


def _line(cell: dict[tuple[str, str], dict[str, Any]]) -> list[str]:
    """One method's figures: in the image with their intervals, in the tip frame without."""
    image = [cell[view, feature] for view, feature, _ in _COLUMNS]
    tip = [cell[view, feature] | {"rmse_ci": None} for view, feature, _ in _TIP_COLUMNS]
    share = min(row["availability_pct"] for row in cell.values())
    return [*_label(image[0]), *map(_figure, image + tip), f"{share:.1f}"]


def markdown(rows: list[dict[str, Any]]) -> str:
    """The tables for people, one for each part and region.

    Args:
        rows: From ``summarise``.

    Returns:
        Markdown.
    """
    blocks: dict[tuple[str, ...], dict[tuple[str, str], dict[str, Any]]] = {}
    for row in rows:
        blocks.setdefault(_key(row), {})[row["view"], row["feature"]] = row
    names = [f"{view} {feature} [{unit}]" for view, feature, unit in _COLUMNS + _TIP_COLUMNS]
    text = []
    for part, region in dict.fromkeys(key[:2] for key in blocks):
        body = [_line(cell) for key, cell in blocks.items() if key[:2] == (part, region)]
        if region == "all":
            body += _paper(part)
        grid = _grid([["edge", "line", "tracker", *names, "frames with a line %"], *body])
        text.append(f"### {part}{'' if region == 'all' else f', {region}s'}\n\n{grid}")
    note = (
        "RMSE over the frames with a line, with 95 % intervals (bootstrap over trials): d_attr and theta in "
        "the image, d_tip and theta_tip in the tip frame. The last column is the least share of frames with "
        "a line, of either view and of both together."
    )
    return "\n\n".join([*text, note])


def _grid(lines: list[list[str]]) -> str:
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    lines = [lines[0], ["-" * w for w in widths], *lines[1:]]
    return "\n".join(
        "| " + " | ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) + " |" for line in lines
    )


_WAYS = {
    ("raw", "none"): ("RANSAC's line", "o", "#8a8f98", False),
    ("raw", "kalman"): ("RANSAC's line, Kalman", "o", "#1f5fa8", False),
    ("refined", "none"): ("refined", "s", "#8a8f98", True),
    ("refined", "kalman"): ("refined, Kalman", "s", "#1f5fa8", True),
    ("refined", "memory"): ("tracker with a memory", "D", "#d1382c", True),
}


def _panel(axes: Any, rows: list[dict[str, Any]], edges: list[str]) -> None:
    """One feature of one part and region: RMSE of each edge method, read in each way."""
    for row in rows:
        if row["rmse"] is None:
            continue
        label, marker, colour, filled = _WAYS["refined" if row["refined"] else "raw", row["tracker"]]
        y = edges.index(row["edge"]) + 0.13 * (
            list(_WAYS.values()).index((label, marker, colour, filled)) - 2
        )
        if row["rmse_ci"]:
            axes.plot(row["rmse_ci"], [y, y], color=colour, lw=1.2)
        face = colour if filled else "white"
        axes.plot(row["rmse"], y, marker, color=colour, mfc=face, ms=5.5, ls="none", label=label)
    paper = PAPER[rows[0]["workpiece"], rows[0]["view"], rows[0]["feature"]]
    axes.axvline(
        paper[0],
        color="#b08900",
        ls=":",
        lw=1.4,
        label="Zhou et al. without Kalman (units unstated, whole seam)",
    )
    axes.axvline(paper[1], color="#b08900", ls="-", lw=1.2, label="Zhou et al. with Kalman")
    axes.set_xscale("log")
    axes.set_ylim(len(edges) - 0.5, -0.5)
    axes.set_yticks(range(len(edges)), edges)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(color="#dddddd", lw=0.6, axis="x")


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Charts the errors in the image: a column for each place on a part, a row for each feature.

    Args:
        rows: From ``summarise``.
        path: The PNG file.
    """
    cells: dict[tuple[str, str], dict[tuple[str, str], list[dict[str, Any]]]] = {}
    for row in rows:
        split = len(catalogue.get(row["workpiece"]).seam.corners) > 0
        if row["feature"] in ("d_attr", "theta") and split == (row["region"] != "all"):
            place = cells.setdefault((row["workpiece"], row["region"]), {})
            place.setdefault((row["view"], row["feature"]), []).append(row)
    edges = list(dict.fromkeys(row["edge"] for row in rows))
    figure, grid = plt.subplots(
        len(_COLUMNS),
        len(cells),
        figsize=(3.6 * len(cells) + 1.0, len(_COLUMNS) * (0.9 + 0.55 * len(edges)) + 1.0),
        squeeze=False,
        sharex="row",
        sharey=True,
        constrained_layout=True,
    )
    for column, ((part, region), place) in zip(grid.T, cells.items(), strict=True):
        for axes, (view, feature, unit) in zip(column, _COLUMNS, strict=True):
            _panel(axes, place[view, feature], edges)
            name = {"d_attr": "attraction distance", "theta": "angle"}[feature]
            axes.set_xlabel(f"{view} view, {name}: RMSE [{unit}]", fontsize=8.5)
        column[0].set_title(part if region == "all" else f"{part}, {region}s")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(
        unique.values(), unique.keys(), loc="outside lower center", ncols=4, fontsize=8.5, frameon=False
    )
    figure.suptitle(
        "Error of the seam's line by edge method and tracker: RMSE, 95 % interval (left is better)"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)
