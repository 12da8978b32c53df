"""Reference simulations of sealant laydown with OpenFOAM: a grid study, and the surrogate's data.

    python -m experiments.laydown grid --out experiments/results --jobs 1
    python -m experiments.laydown runs --out out/laydown --draws 4 --seed 0 --jobs 1
    python -m experiments.laydown sample --data out/laydown --out experiments/data/obstacle_course --draws 3

``grid`` lays one straight bead with a fan on a plane at several cell sizes, with both solvers, and compares
each with the finest. It writes laydown_grid.json, .csv, .md and .png.

``runs`` draws paths around 25 centre paths and 12 unseen ones on an obstacle course (Berg 3.2.2), ``--draws``
around each, one around each before the next. It writes <centre path>.npz: what the surrogate is told and
what it has to predict, by section; and laydown_runs.json, .csv, .md. Both go on where they were stopped.

``sample`` copies the obstacle course's first ``--draws`` out of ``--data``; sample.json says what.
"""

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from agents import engines
from agents.provenance import commit
from experiments import command, laydown_data, laydown_figures, results
from seal_gym.sealant.laydown import foam, sections
from seal_gym.sealant.laydown.config import SOLVERS, THESIS_FLOW_M3S, GridCfg, LaydownCfg, TcpPath
from seal_gym.sealant.laydown.run import simulate

NAME = "laydown"
LENGTH_M, SPEED_MPS, HEIGHT_M = 40e-3, 0.3, 30e-3
STEADY = slice(12, 30)  # sections [mm], away from the bead's ends
CELLS_MM = (2.0, 1.0, 0.75, 0.5)
_LIMIT_S = 7200.0

Row = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One simulation of the grid study.

    Attributes:
        solver: OpenFOAM's.
        cell_mm: Edge of a cell.
    """

    solver: str
    cell_mm: float


def bead(case: Case) -> LaydownCfg:
    """The straight bead of the grid study.

    Args:
        case: Grid and solver.

    Returns:
        The simulation.
    """
    path = TcpPath(
        times_s=np.array([0.0, LENGTH_M / SPEED_MPS]),
        positions=np.array([[0.0, 0.0, HEIGHT_M], [0.0, LENGTH_M, HEIGHT_M]]),
        rotations=np.repeat(np.eye(3)[None], 2, 0),
        flows_m3s=np.full(2, THESIS_FLOW_M3S),
    )
    grid = GridCfg(cell_m=1e-3 * case.cell_mm, solver=case.solver)
    return LaydownCfg(path=path, grid=grid)


def lay(case: Case) -> Row:
    """Lays the straight bead.

    Args:
        case: Grid and solver.

    Returns:
        A row of the table, and under ``section`` the mean of its steady cross-sections.
    """
    cfg = bead(case)
    with tempfile.TemporaryDirectory() as folder:
        laid = simulate(cfg, Path(folder) / "case", limit_s=_LIMIT_S)
    at = sections.stations(cfg)
    images = sections.cut(laid.mesh, laid.fractions, at.hits, at.tips)[STEADY]
    areas = 1e6 * sections.area_m2(images)
    return {
        **asdict(case),
        "cells": len(laid.fractions),
        "area_mm2": float(areas.mean()),
        "area_sd_mm2": float(areas.std()),
        "ideal_mm2": 1e6 * float(at.ideal_m2[STEADY].mean()),
        "width_mm": 1e3 * float(sections.width_m(images).mean()),
        "height_mm": 1e3 * float(sections.height_m(images).mean()),
        "volume_error_pct": 100.0 * laid.volume_error,
        "lid_fraction": laid.lid_fraction,
        "cpu_s": laid.cpu_s,
        "section": np.round(images.mean(0), 4).tolist(),
    }


def compared(rows: list[Row]) -> list[Row]:
    """Adds the intersection over union with the finest bead of the same solver, and across solvers.

    Args:
        rows: From ``lay``.

    Returns:
        Rows without sections, with ``iou_finest`` and ``iou_solvers`` (same cell, other solver).
    """
    out = []
    for row in rows:
        finest = min((r for r in rows if r["solver"] == row["solver"]), key=lambda r: float(r["cell_mm"]))
        other = [r for r in rows if r["cell_mm"] == row["cell_mm"] and r["solver"] != row["solver"]]
        mine = np.array(row["section"])
        kept = {k: v for k, v in row.items() if k != "section"}
        kept["iou_finest"] = float(sections.iou(mine, np.array(finest["section"])))
        kept["iou_solvers"] = float(sections.iou(mine, np.array(other[0]["section"]))) if other else None
        out.append(kept)
    return out


def markdown(rows: list[Row]) -> str:
    """The grid study's table.

    Args:
        rows: From ``compared``.

    Returns:
        Markdown.
    """
    head = ["solver", "cell mm", "area mm²", "width mm", "height mm", "IoU finest", "IoU solvers"]
    head += ["volume error %", "CPU s"]
    body = [
        [
            r["solver"],
            f"{r['cell_mm']:g}",
            f"{r['area_mm2']:.1f} ± {r['area_sd_mm2']:.1f}",
            results.number(r["width_mm"], 1),
            results.number(r["height_mm"], 2),
            results.number(r["iou_finest"], 2),
            results.number(r["iou_solvers"], 2),
            results.number(r["volume_error_pct"], 2),
            results.number(r["cpu_s"], 0),
        ]
        for r in rows
    ]
    fan_mm = 2e3 * HEIGHT_M * math.tan(math.radians(20.0))
    return (
        f"A fan of 40 deg, {1e3 * HEIGHT_M:g} mm above a plane, {SPEED_MPS:g} m/s: flow / speed is "
        f"{rows[0]['ideal_mm2']:.1f} mm², the fan {fan_mm:.1f} mm wide. Area, width (where it is 0.5 mm "
        "thick) and height are means of 18 sections 1 mm apart; IoU is of the mean section in 1 mm pixels: "
        "with the same solver on the finest grid, and with the other solver on the same grid.\n\n"
        + results.grid(head, body)
    )


def resumed(
    wanted: list[Any], work: Callable[[Any], Row], log: Path, jobs: int, title: str
) -> Iterator[tuple[Any, Row, bool]]:
    """Runs what a log does not hold yet.

    Args:
        wanted: Units of work, frozen dataclasses.
        work: Runs one.
        log: Has a line for each unit that was run; a row is logged when the caller asks for the next.
        jobs: Processes.
        title: Of the progress bar.

    Yields:
        Each unit, its row (without ``laydown_data.ARRAYS`` if it is the log's), whether it was run now.
    """
    text = log.read_text(encoding="utf-8") if log.exists() else ""
    done = {}
    for line in text.splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue  # the line a killed run was writing
        if row.get("error") is None:  # what failed is tried again
            done[json.dumps(row.pop("unit"), sort_keys=True)] = row
    keys = {unit: json.dumps(asdict(unit), sort_keys=True) for unit in wanted}
    missing = [unit for unit in wanted if keys[unit] not in done]
    for unit in wanted:
        if keys[unit] in done:
            yield unit, done[keys[unit]], False
    start = len(wanted) - len(missing)
    with (
        log.open("a", encoding="utf-8") as file,
        tqdm(total=len(wanted), initial=start, desc=title, unit="run") as bar,
    ):
        if text and not text.endswith("\n"):
            file.write("\n")
        for unit, row in engines.local(jobs)(work, missing):
            yield unit, row, True
            kept = {k: v for k, v in row.items() if k != laydown_data.ARRAYS}
            file.write(json.dumps({"unit": asdict(unit), **kept}) + "\n")
            file.flush()
            bar.update()


def grid(options: argparse.Namespace) -> str:
    """Does the grid study.

    Args:
        options: With ``out``, ``jobs``, ``finest``.

    Returns:
        The table.
    """
    cases = [Case(solver, cell) for cell in CELLS_MM if cell >= options.finest for solver in SOLVERS]
    log = options.out / "laydown_grid.trials.jsonl"
    found = {c: row for c, row, _ in resumed(cases, lay, log, options.jobs, "grid")}
    full = [found[c] for c in sorted(cases, key=lambda c: (c.solver, -c.cell_mm))]
    rows = compared(full)
    text = markdown(rows)
    results.write(
        options.out, "laydown_grid", rows, [], renderer="none", regime="static", text=text, module=NAME
    )
    laydown_figures.grid(options.out / "laydown_grid.png", full)
    return text


def runs(options: argparse.Namespace) -> str:
    """Makes the surrogate's data.

    Args:
        options: With ``out``, ``jobs``, ``seed``, ``draws``, ``cell``, ``solver``.

    Returns:
        The table.
    """
    wanted = laydown_data.plan(options.draws, options.seed, options.cell, options.solver)
    log = options.out / "laydown_runs.trials.jsonl"
    laydown_data.check_settings(log, wanted[0])
    rows = []
    for run, row, new in resumed(wanted, laydown_data.simulate_run, log, options.jobs, "runs"):
        if new and row["error"] is None:
            laydown_data.store(options.out / f"{run.path}.npz", run.draw, row[laydown_data.ARRAYS])
        rows.append({**asdict(run), **{k: v for k, v in row.items() if k != laydown_data.ARRAYS}})
    table = laydown_data.summary(rows)
    text = laydown_data.markdown(table)
    results.write(
        options.out, "laydown_runs", table, rows, renderer="none", regime="static", text=text, module=NAME
    )
    return text


def sample(options: argparse.Namespace) -> str:
    """Copies the obstacle course.

    Args:
        options: With ``data``, ``out``, ``draws``.

    Returns:
        The table of what was copied.
    """
    rows = laydown_data.sample(options.data, options.out, options.draws)
    about = {"name": "laydown_sample", "command": results.command(NAME), "git_commit": commit(), "rows": rows}
    (options.out / "sample.json").write_text(results.document_text(about), encoding="utf-8")
    return results.grid(list(rows[0]), [[str(v) for v in r.values()] for r in rows])


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.laydown", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "what",
        choices=("grid", "runs", "sample"),
        help="the grid study, the surrogate's data, a part of them",
    )
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="simulations at a time (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the drawn paths (default: %(default)s)")
    parser.add_argument(
        "--draws", type=int, default=4, help="runs, sample: of each path (default: %(default)s)"
    )
    default = Path("out") / NAME
    parser.add_argument("--data", type=Path, default=default, help="sample: of runs (default: %(default)s)")
    parser.add_argument(
        "--finest", type=float, default=0.5, help="grid: smallest cell [mm] (default: %(default)s)"
    )
    parser.add_argument("--cell", type=float, default=1.0, help="runs: cell [mm] (default: %(default)s)")
    parser.add_argument("--solver", default=SOLVERS[0], choices=SOLVERS, help="runs: (default: %(default)s)")
    options = command.checked(parser, arguments, jobs=1, seed=0, draws=1)
    if not options.finest <= max(CELLS_MM):
        parser.error(f"--finest {options.finest}: must be at most {max(CELLS_MM)}")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Runs the study or makes the data.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status, see ``command.run``.
    """
    options = parse(arguments)

    def do() -> str:
        if options.what == "sample":
            return sample(options)
        for solver in SOLVERS:
            foam.find(solver)
        return grid(options) if options.what == "grid" else runs(options)

    return command.run(do, options.out)


if __name__ == "__main__":
    sys.exit(main())
