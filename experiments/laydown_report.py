"""Tables and pictures of the laydown reference."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np

from experiments import results
from seal_gym.core.frames import Array
from seal_gym.sealant.laydown import sections

_SHOWN = ("area_mm2", "width_mm", "height_mm")
_MM2 = 1e6
_WINDOW_MM = (-20.0, 20.0, -1e3 * sections.BELOW_M, 20.0 - 1e3 * sections.BELOW_M)

Found = dict[tuple[str, float], tuple[Array, dict[str, Any]]]


class Named(Protocol):
    """A run that a picture is labelled with."""

    draw: int
    split: str

    @property
    def name(self) -> str:
        """Its name."""
        ...


def richardson(cells: list[float], values: list[float]) -> tuple[float, float] | None:
    """Extrapolates three values to cells of no size, by an order that fits them.

    Args:
        cells: Three sizes, from coarse to fine.
        values: One a size.

    Returns:
        The limit and the order; None unless the values approach one from one side.
    """
    (h1, h2, h3), (f1, f2, f3) = cells, values
    ratio = (f1 - f2) / (f2 - f3) if f2 != f3 else -1.0
    if ratio <= 0:
        return None

    def excess(p: float) -> float:
        return (h1**p - h2**p) / (h2**p - h3**p) - ratio

    low, high = 0.05, 8.0
    if excess(low) * excess(high) > 0:
        return None
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) * excess(low) > 0 else (low, middle)
    p = 0.5 * (low + high)
    return f3 + (f3 - f2) * h3**p / (h2**p - h3**p), p


def grid_rows(found: Found) -> list[dict[str, Any]]:
    """Rows of the grid study.

    Args:
        found: Cross-sections (n, 20, 40) and facts of each solver and cell size [mm].

    Returns:
        One each; the intersection over union is with the finest grid of the same solver and with the other solver
        on the same grid, of the mean section.
    """
    finest = {solver: min(c for s, c in found if s == solver) for solver, _ in found}
    rows = []
    for (solver, cell), (images, facts) in found.items():
        other = next((s for s, c in found if s != solver and c == cell), None)
        mean = images.mean(0)
        rows.append(
            {
                "solver": solver,
                "cell_mm": cell,
                "cells": facts["cells"],
                "area_mm2": _MM2 * float(sections.area_m2(images).mean()),
                "area_sd_mm2": _MM2 * float(sections.area_m2(images).std()),
                "ideal_mm2": facts["ideal_mm2"],
                "width_mm": 1e3 * float(sections.width_m(mean)),
                "height_mm": 1e3 * float(sections.height_m(mean)),
                "iou_finest": float(sections.iou(mean, found[solver, finest[solver]][0].mean(0))),
                "iou_other": None
                if other is None
                else float(sections.iou(mean, found[other, cell][0].mean(0))),
                "volume_error": facts["volume_error"],
                "cpu_s": facts["cpu_s"],
            }
        )
    return rows


def grid_table(rows: list[dict[str, Any]]) -> str:
    """The grid study for people.

    Args:
        rows: From ``grid_rows``.

    Returns:
        Markdown; below the table, what the three finest grids of each solver extrapolate to.
    """
    head = ["solver", "cell mm", "cells", "area mm2 (sd)", "flow/speed mm2", "width mm", "height mm"]
    head += ["IoU with finest", "IoU with other solver", "volume error", "CPU s"]
    body = [
        [
            row["solver"],
            f"{row['cell_mm']:g}",
            str(row["cells"]),
            f"{row['area_mm2']:.2f} ({row['area_sd_mm2']:.2f})",
            f"{row['ideal_mm2']:.2f}",
            f"{row['width_mm']:.2f}",
            f"{row['height_mm']:.2f}",
            f"{row['iou_finest']:.3f}",
            results.number(row["iou_other"], 3),
            f"{row['volume_error']:+.1e}",
            f"{row['cpu_s']:.0f}",
        ]
        for row in rows
    ]
    lines = [results.grid(head, body), ""]
    for solver in dict.fromkeys(row["solver"] for row in rows):
        of = sorted((r for r in rows if r["solver"] == solver), key=lambda r: -r["cell_mm"])[-3:]
        for key in _SHOWN if len(of) == 3 else ():
            limit = richardson([r["cell_mm"] for r in of], [r[key] for r in of])
            name = key.removesuffix("_mm").removesuffix("_mm2")
            unit = key.removeprefix(f"{name}_")
            values = ", ".join(f"{r[key]:.2f}" for r in of)
            text = f"{limit[0]:.2f} {unit}, order {limit[1]:.1f}" if limit else "not monotone, no limit"
            lines.append(f"- {solver}, {name} ({values}): {text}")
    return "\n".join(lines)


def runs_table(rows: list[dict[str, Any]]) -> str:
    """The data set's runs by centre path, for people.

    Args:
        rows: One a run.

    Returns:
        Markdown.
    """
    head = ["split", "centre path", "substrate", "runs", "sections", "area mm2", "flow/speed mm2", "width mm"]
    head += ["height mm", "worst volume error", "CPU s a run"]
    body = []
    for name in dict.fromkeys(row["centre_path"] for row in rows):
        of = [row for row in rows if row["centre_path"] == name]
        mean = {k: float(np.mean([r[k] for r in of])) for k in (*_SHOWN, "ideal_area_mm2", "cpu_s")}
        body.append(
            [
                of[0]["split"],
                name,
                of[0]["substrate"],
                str(len(of)),
                str(sum(r["sections"] for r in of)),
                f"{mean['area_mm2']:.1f}",
                f"{mean['ideal_area_mm2']:.1f}",
                f"{mean['width_mm']:.1f}",
                f"{mean['height_mm']:.1f}",
                f"{max((r['volume_error'] for r in of), key=abs):+.1e}",
                f"{mean['cpu_s']:.0f}",
            ]
        )
    total = f"{len(rows)} runs, {sum(r['sections'] for r in rows)} sections, {sum(r['cpu_s'] for r in rows):.0f} CPU s"
    left = [r for r in rows if not r["sections"]]
    names = ", ".join(
        f"{r['centre_path']}.{r['draw']} ({r['volume_error']:+.1e}, lid {r['lid_fraction']:.2f})"
        for r in left
    )
    return "\n".join([results.grid(head, body), "", total, *([f"Left out: {names}"] if left else [])])


def grid_picture(file: Path, found: Found) -> None:
    """Mean cross-sections of the grid study.

    Args:
        file: PNG.
        found: As ``grid_rows`` takes it.
    """
    plt = _pyplot()
    solvers, cells = (list(dict.fromkeys(key[k] for key in found)) for k in (0, 1))
    figure, axes = plt.subplots(
        len(cells), len(solvers), figsize=(10, 1.9 * len(cells)), squeeze=False, sharex=True
    )
    for (solver, cell), (images, _) in found.items():
        axis = axes[cells.index(cell)][solvers.index(solver)]
        axis.imshow(images.mean(0), origin="lower", extent=_WINDOW_MM, vmin=0, vmax=1, cmap="viridis")
        axis.set_ylim(-1, 5)
        axis.set_title(f"{solver}, {cell:g} mm cells", fontsize=11)
        axis.set_ylabel("z [mm]")
    for axis in axes[-1]:
        axis.set_xlabel("across travel [mm]")
    figure.suptitle("Mean cross-section of a straight fan bead; colour: volume fraction 0 to 1")
    figure.tight_layout()
    figure.savefig(file, dpi=110)
    plt.close(figure)


def gallery(file: Path, found: list[tuple[Any, dict[str, Any], dict[str, Array]]]) -> None:
    """Beads from above, the first draw of each centre path.

    Args:
        file: PNG.
        found: Job, facts and arrays of each run.
    """
    plt = _pyplot()
    first = [item for item in found if item[0].draw == 0]
    columns = 6
    rows = -(-len(first) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(2.6 * columns, 2.9 * rows), squeeze=False)
    for axis in axes.flat:
        axis.set_visible(False)
    for axis, (job, facts, arrays) in zip(axes.flat, first, strict=False):
        axis.set_visible(True)
        cell, low = facts["cell_mm"], 1e3 * arrays["origin"]
        thick = arrays["bead"].astype(float).sum(2) / 255.0 * cell
        nx, ny = thick.shape
        extent = (low[0], low[0] + nx * cell, low[1], low[1] + ny * cell)
        shown = axis.imshow(thick.T, origin="lower", extent=extent, vmin=0, vmax=8, cmap="magma")
        axis.plot(*(1e3 * arrays["hits_m"][:, :2].T), color="cyan", linewidth=1)
        axis.set_title(job.centre.name, fontsize=10)
        axis.tick_params(labelsize=8)
    figure.tight_layout(rect=(0, 0, 0.94, 0.97))
    bar = figure.add_axes((0.955, 0.3, 0.01, 0.4))
    figure.colorbar(shown, cax=bar, label="thickness [mm]")
    figure.suptitle("Beads from above, x and y [mm]; line: where the nozzle points")
    figure.savefig(file, dpi=80)
    plt.close(figure)


def atlas(file: Path, found: list[tuple[Any, dict[str, Any], dict[str, Array]]]) -> None:
    """A cross-section across travel in the middle of each centre path's first draw.

    Args:
        file: PNG.
        found: Job, facts and arrays of each run.
    """
    plt = _pyplot()
    first = [item for item in found if item[0].draw == 0]
    columns = 5
    rows = -(-len(first) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.0 * columns, 1.85 * rows), squeeze=False)
    for axis in axes.flat:
        axis.set_visible(False)
    for axis, (job, _, arrays) in zip(axes.flat, first, strict=False):
        axis.set_visible(True)
        image = arrays["images_across"][len(arrays["arcs_m"]) // 2] / 255.0
        axis.imshow(image, origin="lower", extent=_WINDOW_MM, vmin=0, vmax=1, cmap="viridis")
        axis.set_title(job.centre.name, fontsize=10)
        axis.tick_params(labelsize=8)
    figure.suptitle(
        "Cross-sections in the middle of the paths, across travel, mm; colour: volume fraction 0 to 1"
    )
    figure.tight_layout(rect=(0, 0, 1, 0.98))
    figure.savefig(file, dpi=80)
    plt.close(figure)


def _pyplot() -> Any:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt
