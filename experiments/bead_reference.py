"""Beads of the eight bead cases in the reference: OpenFOAM lays the naive and the optimal path.

    python -m experiments.bead_reference --out experiments/results --cell 1.0

For each case of ``seal_gym.planning.bead_cases`` (Berg, Fig. 3.6; its Figs. 4.1-4.7 are pictures of such
simulations) the paths of ``experiments.bead_paths`` are laid with OpenFOAM, in pieces of some 60 mm that
overlap, and measured like the fast tier's beads: thickness along the columns of ``bead_laydown.strip_of``,
2 mm inside both edges. Writes the table as JSON, CSV and Markdown and for each case a picture of both beads.
Goes on where it was stopped; thicknesses are kept in <out>/bead_reference_fields.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from experiments import bead_laydown, bead_maps, command, results
from experiments.bead_laydown import Comparison, EdgeHeights, Places, centre_line, edge_heights
from experiments.bead_substrates import roomy, simulation, substrate_of
from experiments.laydown import resumed
from experiments.laydown_data import ARRAYS
from seal_gym.core.frames import Array
from seal_gym.planning import bead_cases
from seal_gym.planning.bead_cases import BeadCase
from seal_gym.planning.bead_config import BeadCfg
from seal_gym.planning.bead_curves import Edges
from seal_gym.planning.bead_geometry import BeadPath
from seal_gym.planning.bead_path import FINER, naive_path, timed_path
from seal_gym.planning.bead_solver import BeadSolution, solve
from seal_gym.sealant.fan import Laid
from seal_gym.sealant.laydown import foam
from seal_gym.sealant.laydown.config import GridCfg
from seal_gym.sealant.laydown.pieces import split, thickness_m, trace
from seal_gym.sealant.laydown.run import simulate
from seal_gym.sealant.strip import Strip

NAME = "bead_reference"
PATHS = ("naive", "ipopt")
PIECE_M, OVERLAP_M = 60e-3, 12e-3
STEP_S = 2e-3  # the tip moves half a millimetre
NEAR_M = 25e-3  # no column so far from where the nozzle points at has sealant
BEAD_M = 0.5e-3  # a column is bead from this height on, as in ``laydown.sections``
_LIMIT_S = 3600.0

Row = dict[str, Any]


@dataclass(frozen=True)
class Run:
    """One path to lay.

    Attributes:
        case: Name.
        path: Of ``PATHS``.
        cell_mm: Edge of a cell.
    """

    case: str
    path: str
    cell_mm: float


def paths_of(case: BeadCase, edges: Edges, cfg: BeadCfg) -> dict[str, BeadPath]:
    """A case's paths, as ``experiments.bead_paths`` has them.

    Args:
        case: The case.
        edges: Its edges.
        cfg: Limits and weights.

    Returns:
        ``naive``, and ``ipopt`` if there is one.
    """
    paths = {"naive": naive_path(edges, case.duration_s, cfg, FINER * 240 + 1)}
    found = solve(edges, case.duration_s, cfg)
    if isinstance(found, BeadSolution):
        paths["ipopt"] = timed_path(edges, found.nodes.finer(FINER), cfg)
    return paths


def lay(
    case: BeadCase, edges: Edges, strip: Strip, path: BeadPath, cell_m: float, *, piece_m: float = PIECE_M
) -> tuple[Laid, Row]:
    """Lays a path with OpenFOAM.

    Args:
        case: The case.
        edges: Its edges.
        strip: Of the case, see ``bead_laydown.strip_of``.
        path: In the case's frame.
        cell_m: Edge of a cell [m].
        piece_m: About the length of the pieces in which it is laid [m].

    Returns:
        The bead on the strip's columns, and of the simulations: ``pieces``, ``cells`` (most),
        ``volume_error_pct`` (worst), ``lid_fraction`` (worst), ``cpu_s`` (sum).
    """
    part = substrate_of(case, edges)
    whole = simulation(part, path, BeadCfg().nozzle.fan_angle_rad, GridCfg(cell_m=cell_m, inlet_dt_s=STEP_S))
    _, places = trace(whole)
    columns = np.broadcast_to(strip.column[:, None], strip.base.shape)
    _, nearest = cKDTree(places).query(strip.base, distance_upper_bound=NEAR_M)
    when = np.append(whole.path.times_s, np.inf)[nearest]
    height, rows = np.zeros(strip.area.shape), []
    pieces = split(whole, piece_m, OVERLAP_M)
    for piece in pieces:
        cfg = roomy(case, piece.cfg)
        with tempfile.TemporaryDirectory() as folder:
            laid = simulate(cfg, Path(folder) / "case", limit_s=_LIMIT_S)
        last = piece is pieces[-1]
        mine = strip.there & (when >= piece.begin_s) & ((when < piece.end_s) | (last & np.isfinite(when)))
        height[mine] = thickness_m(
            laid.mesh, laid.fractions, strip.base[mine], columns[mine], cfg.grid.clearance_m
        )
        rows.append((len(laid.fractions), laid.volume_error, laid.lid_fraction, laid.cpu_s))
    cells, error, lid, cpu = np.array(rows).T
    volume, sprayed = np.asarray(strip.volume(height)), whole.path.volume_m3()
    bead = Laid(volume, height, sprayed - float(volume.sum()), sprayed)
    return bead, {
        "pieces": len(pieces),
        "cells": int(cells.max()),
        "volume_error_pct": 100.0 * float(error[np.argmax(np.abs(error))]),
        "lid_fraction": float(lid.max()),
        "cpu_s": float(cpu.sum()),
    }


def dimensions(edges: Edges, strip: Strip, laid: Laid, at: Places) -> Row:
    """Mean width and area of a bead.

    Args:
        edges: Its edges.
        strip: Under it.
        laid: The bead.
        at: Where its edges' heights are measured.

    Returns:
        ``width_mm``, where it is at least ``BEAD_M`` high; ``area_mm2``; ``ideal_mm2``, sprayed volume over
        length; ``edges_mm``, distance of the edges.
    """
    length = centre_line(edges).length_m
    inset = bead_laydown.INSET_M
    return {
        "width_mm": 1e3 * float(strip.area[laid.height >= BEAD_M].sum()) / length,
        "area_mm2": 1e6 * float(laid.volume.sum()) / length,
        "ideal_mm2": 1e6 * laid.sprayed_m3 / length,
        "edges_mm": 1e3 * float(np.linalg.norm(at.left - at.right, axis=1).mean() + 2 * inset),
    }


def work(run: Run) -> Row:
    """Lays one path.

    Args:
        run: Which.

    Returns:
        Its columns, and the heights of the columns under ``laydown_data.ARRAYS``.
    """
    case, cfg = bead_cases.get(run.case), BeadCfg()
    edges = case.edges()
    path = paths_of(case, edges, cfg).get(run.path)
    if path is None:
        return {"there": False, ARRAYS: {}}
    strip = bead_laydown.strip_of(case, edges)
    laid, row = lay(case, edges, strip, path, 1e-3 * run.cell_mm)
    return {"there": True, **row, ARRAYS: {"height": laid.height.astype(np.float32)}}


def field_file(out: Path, run: Run) -> Path:
    """Where a run's thicknesses are kept.

    Args:
        out: Folder of the results.
        run: The run.

    Returns:
        The file.
    """
    return out / f"{NAME}_fields" / f"{run.case}_{run.path}_{run.cell_mm:g}.npz"


def compared(case: BeadCase, cfg: BeadCfg, heights: dict[str, Array], out: Path) -> Row:
    """Measures and draws a case's beads.

    Args:
        case: The case.
        cfg: For the nozzle.
        heights: Of the columns, by path.
        out: Folder of the figure.

    Returns:
        Heights of ``Comparison.row``, dimensions, and the fast tier's differences at the corners.
    """
    edges = case.edges()
    strip = bead_laydown.strip_of(case, edges)
    at = bead_laydown.places(edges, strip)
    paths = paths_of(case, edges, cfg)
    sprayed = cfg.nozzle.flow_m3_per_s * case.duration_s
    laid: dict[str, Laid] = {}
    for who, height in heights.items():
        volume = np.asarray(strip.volume(height))
        laid[who] = Laid(volume, height, sprayed - float(volume.sum()), sprayed)
    found = Comparison(
        strip=strip, laid=laid, heights={who: edge_heights(strip, bead, at) for who, bead in laid.items()}
    )
    fast: dict[str, EdgeHeights] = {
        who: edge_heights(strip, bead_laydown.lay(strip, paths[who], cfg.nozzle.fan_angle_rad), at)
        for who in laid
    }
    beside = bead_maps.Beside(heights=fast, label="in the fast tier")
    file = out / f"{NAME}_{case.name}.png"
    bead_maps.draw(file, case, edges, found, title="Bead in the reference", beside=beside)
    row = {key: value for key, value in found.row().items() if not key.startswith("robot")}
    for who in PATHS:
        sizes = dimensions(edges, strip, laid[who], at) if who in laid else {}
        for key in ("width_mm", "area_mm2", "ideal_mm2", "edges_mm"):
            row[f"{who}_{key}"] = sizes.get(key)
        row[f"{who}_fast_corner_mm"] = fast[who].row()["laid_corner_mm"] if who in fast else None
        row[f"{who}_from_fast_mm"] = _deviation_mm(found.heights[who], fast[who]) if who in fast else None
    return row


def _deviation_mm(one: EdgeHeights, other: EdgeHeights) -> float:
    """Root mean square difference of heights at both edges."""
    off = np.concatenate((one.left_m - other.left_m, one.right_m - other.right_m))
    return 1e3 * float(np.sqrt(np.mean(off**2)))


def markdown(rows: list[Row], cell_mm: float) -> str:
    """The tables for people.

    Args:
        rows: One a case.
        cell_mm: Edge of a cell.

    Returns:
        Markdown.
    """
    number = results.number

    def span(row: Row, who: str) -> str:
        low, high = row[f"{who}_laid_min_mm"], row[f"{who}_laid_max_mm"]
        return "-" if low is None else f"{low:.2f} to {high:.2f}"

    def corner(row: Row, who: str) -> str:
        mean, worst = row[f"{who}_laid_corner_mm"], row[f"{who}_laid_corner_worst_mm"]
        return "-" if mean is None else f"{mean:.2f} ({worst:.2f})"

    first = results.grid(
        [
            "case",
            "naive heights mm",
            "optimal heights mm",
            "difference at corners, naive mm",
            "optimal mm",
            "reduction",
            "fast tier: naive mm",
            "optimal mm",
            "from the fast tier, rms: naive mm",
            "optimal mm",
        ],
        [
            [
                row["case"],
                span(row, "naive"),
                span(row, "ipopt"),
                corner(row, "naive"),
                corner(row, "ipopt"),
                row["reduction_word"] or f"{row['ipopt_reduction']:.1f} times",
                *(number(row[f"{who}_fast_corner_mm"], 2) for who in PATHS),
                *(number(row[f"{who}_from_fast_mm"], 2) for who in PATHS),
            ]
            for row in rows
        ],
    )
    second = results.grid(
        [
            "case",
            "path",
            "edges mm",
            "width mm",
            "area mm²",
            "Q / v mm²",
            "pieces",
            "cells",
            "volume %",
            "CPU s",
        ],
        [
            [
                row["case"],
                {"naive": "naive", "ipopt": "optimal"}[who],
                *(
                    number(row[f"{who}_{key}"], 1)
                    for key in ("edges_mm", "width_mm", "area_mm2", "ideal_mm2")
                ),
                number(row[f"{who}_pieces"], 0),
                number(row[f"{who}_cells"], 0),
                number(row[f"{who}_volume_error_pct"], 2),
                number(row[f"{who}_cpu_s"], 0),
            ]
            for row in rows
            for who in PATHS
            if row[f"{who}_pieces"] is not None
        ],
    )
    about = (
        f"OpenFOAM (interFoam), cells of {cell_mm:g} mm, neutral silicone, a fan of 40 deg whose jet "
        f"leaves at 3 m/s with the tip's velocity added; paths in pieces of about {1e3 * PIECE_M:g} mm "
        f"that overlap by {1e3 * OVERLAP_M:g} mm, so that beginning and end of a closed path do not meet. "
        "Height at an edge: mean over the columns within 1 mm of a place 2 mm inside it, every "
        "millimetre, smallest to largest over both edges; the same places and columns as in the fast "
        "tier's table (bead_paths.md). Difference at corners: between left and right edge where the "
        "centre line turns at least half as sharply as it does anywhere, mean (largest). Reduction: the "
        "naive mean difference over the optimal one. From the fast tier: root mean square difference of "
        "the heights at both edges. Over edges (over_corner, stairs) the tip swings round at up to four "
        "times the bead's speed and the jet carries that along: it leaves the edge thin and heaps up what "
        "is missing there behind it, or before hollow corners; neither path nor fast tier knows of it."
    )
    sizes = (
        f"Width: mean over the path, where the bead is at least {1e3 * BEAD_M:g} mm high; area: mean, of "
        "what lies on the columns (in the half circle without what fills the gap); Q / v: sprayed volume "
        "over the centre line's length; volume: worst relative error of a piece's volume; CPU time of the"
        " solver, one core. The thesis' Figs. 4.1, 4.3, 4.5 and 4.7 show simulated beads of the first "
        "four cases as pictures without scales or numbers: there is nothing to compare figures with."
    )
    pictures = [f"![{row['case']}]({NAME}_{row['case']}.png)" for row in rows]
    return "\n\n".join((first, about, second, sizes, *pictures))


def make(options: argparse.Namespace) -> str:
    """Does all of it.

    Args:
        options: With ``out``, ``case``, ``cell``, ``jobs``.

    Returns:
        The tables.
    """
    names = [name for name in bead_cases.CASES if not options.case or name in options.case]
    wanted = [
        Run(name, who, options.cell)
        for name in names
        for who in PATHS
        if who == "naive" or bead_cases.get(name).feasible
    ]
    (options.out / f"{NAME}_fields").mkdir(parents=True, exist_ok=True)
    found: dict[tuple[str, str], Row] = {}
    fields: dict[str, dict[str, Array]] = {name: {} for name in names}
    for run, row, new in resumed(wanted, work, options.out / f"{NAME}.trials.jsonl", options.jobs, "beads"):
        if new and row["there"]:
            np.savez_compressed(field_file(options.out, run), **row[ARRAYS])
        found[run.case, run.path] = {key: value for key, value in row.items() if key != ARRAYS}
        if row["there"]:
            with np.load(field_file(options.out, run)) as stored:
                fields[run.case][run.path] = stored["height"].astype(float)
    rows = []
    for name in names:
        row = {"case": name, "cell_mm": options.cell}
        row |= compared(bead_cases.get(name), BeadCfg(), fields[name], options.out)
        for who in PATHS:
            run_row = found.get((name, who), {})
            for key in ("pieces", "cells", "volume_error_pct", "lid_fraction", "cpu_s"):
                row[f"{who}_{key}"] = run_row.get(key)
        rows.append(row)
    text = markdown(rows, options.cell)
    results.write(options.out, NAME, rows, [], renderer="none", regime="static", text=text)
    return text


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{NAME}", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--case", action="append", choices=bead_cases.CASES, help="may be repeated (default: all)"
    )
    parser.add_argument("--cell", type=float, default=1.0, help="edge of a cell [mm] (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="simulations at a time (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    options = command.checked(parser, arguments, jobs=1)
    if not 0.25 <= options.cell <= 4.0:
        parser.error(f"--cell {options.cell}: must be in [0.25, 4] mm")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Makes the tables and the figures.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status, see ``command.run``.
    """
    options = parse(arguments)

    def do() -> str:
        foam.find("interFoam")
        return make(options)

    return command.run(do, options.out)


if __name__ == "__main__":
    sys.exit(main())
