"""The surrogate's data: random tip paths, their simulated beads, one file for each centre path."""

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.provenance import commit
from experiments import results
from seal_gym.core.errors import ConfigError, SealGymError, require
from seal_gym.core.frames import Array
from seal_gym.sealant.laydown import paths, sections
from seal_gym.sealant.laydown.config import GridCfg, LaydownCfg
from seal_gym.sealant.laydown.run import simulate, with_room

ARRAYS = "arrays"
CENTRE_PATHS = {p.name: p for p in paths.TRAINING + paths.VALIDATION}
INPUTS = ("arc_m", "linear_mps", "angular_radps", "gravity_mps2", "heights_m")
MOST_VOLUME_ERROR, MOST_LID = 0.05, 0.5
_LIMIT_S = 1800.0

Row = dict[str, Any]


@dataclass(frozen=True)
class Run:
    """One simulation of the data.

    Attributes:
        path: Name of the centre path.
        draw: Number of the path drawn around it.
        seed: Of the draws.
        cell_mm: Edge of a cell.
        solver: OpenFOAM's.
    """

    path: str
    draw: int
    seed: int
    cell_mm: float
    solver: str


def plan(draws: int, seed: int, cell_mm: float, solver: str) -> list[Run]:
    """The runs, one around each centre path before the next.

    Args:
        draws: Of each centre path.
        seed: Of the draws.
        cell_mm: Edge of a cell.
        solver: OpenFOAM's.

    Returns:
        37 times ``draws`` runs.
    """
    return [Run(name, draw, seed, cell_mm, solver) for draw in range(draws) for name in CENTRE_PATHS]


def simulation(run: Run) -> LaydownCfg:
    """What a run simulates.

    Args:
        run: The run.

    Returns:
        The simulation; its path depends on seed, centre path and draw alone.
    """
    centre = CENTRE_PATHS[run.path]
    rng = np.random.default_rng([run.seed, list(CENTRE_PATHS).index(run.path), run.draw])
    return with_room(
        LaydownCfg(
            path=paths.random_tip_path(centre, rng),
            substrate=centre.substrate,
            gravity_mps2=centre.gravity_mps2,
            grid=GridCfg(cell_m=1e-3 * run.cell_mm, solver=run.solver),
        )
    )


def simulate_run(run: Run) -> Row:
    """Lays a run's bead and cuts it.

    Args:
        run: The run.

    Returns:
        What it cost and how well it went; ``error`` is None or why it is no use; else the data by section.
    """
    begin = time.perf_counter()
    row: Row = {"commit": commit(), "error": None, "volume_error": None, "lid_fraction": None, "cpu_s": None}
    row |= {"cells": None, "sections": 0}
    try:
        cfg = simulation(run)
        with tempfile.TemporaryDirectory() as folder:
            laid = simulate(cfg, Path(folder) / "case", limit_s=_LIMIT_S)
        at = sections.stations(cfg)
    except SealGymError as error:
        return row | {"error": str(error), "wall_s": time.perf_counter() - begin}
    row |= {"volume_error": laid.volume_error, "lid_fraction": laid.lid_fraction, "cpu_s": laid.cpu_s}
    row |= {"cells": len(laid.fractions), "sections": len(at.arcs_m)}
    if abs(laid.volume_error) > MOST_VOLUME_ERROR or laid.lid_fraction > MOST_LID:
        row["error"] = (
            f"volume off by {laid.volume_error:.1%}, {laid.lid_fraction:.0%} full at the mesh's top"
        )
    else:
        row[ARRAYS] = data(laid.mesh, laid.fractions, at)
    return row | {"wall_s": time.perf_counter() - begin}


def data(mesh: Any, fractions: Array, at: sections.Stations) -> dict[str, np.ndarray[Any, Any]]:
    """The data of one run, by section.

    Args:
        mesh: Of the simulation.
        fractions: Of sealant by cell.
        at: Where to cut.

    Returns:
        The surrogate's inputs (``linear_mps``, ``angular_radps``, ``gravity_mps2``, ``heights_m``), its
        target ``image`` (n, 20, 40; 255 is full; rows up), the area, width and height of a cut across travel
        instead, and what the area should be.
    """
    across = sections.cut(mesh, fractions, at.hits, at.across)
    single = {
        "time_s": at.times_s,
        "arc_m": at.arcs_m,
        "linear_mps": at.linear_mps,
        "angular_radps": at.angular_radps,
        "gravity_mps2": at.gravity_mps2,
        "heights_m": at.heights_m,
        "ideal_m2": at.ideal_m2,
        "across_area_m2": sections.area_m2(across),
        "across_width_m": sections.width_m(across),
        "across_height_m": sections.height_m(across),
    }
    image = np.round(255.0 * sections.cut(mesh, fractions, at.hits, at.tips)).astype(np.uint8)
    return {**{k: v.astype(np.float32) for k, v in single.items()}, "image": image}


def check_settings(log: Path, run: Run) -> None:
    """Refuses a folder with other runs: its files know draws by their numbers alone.

    Args:
        log: Of the folder's runs.
        run: One that is wanted.

    Raises:
        ConfigError: If the log has a run with another seed, cell or solver.
    """
    wanted = {"seed": run.seed, "cell_mm": run.cell_mm, "solver": run.solver}
    for line in log.read_text(encoding="utf-8").splitlines() if log.exists() else []:
        try:
            unit = json.loads(line)["unit"]
        except (json.JSONDecodeError, KeyError):
            continue  # the line a killed run was writing
        found = {name: unit[name] for name in wanted}
        if found != wanted:
            raise ConfigError(f"{log.parent} holds runs with {found}, not {wanted}: use another --out")


def store(path: Path, draw: int, arrays: dict[str, np.ndarray[Any, Any]]) -> None:
    """Adds a run's sections to a centre path's file; ``draw`` says which run a section is of.

    Args:
        path: The file; made if need be.
        draw: Number of the run; its sections in the file are replaced.
        arrays: From ``data``.
    """
    new = {"draw": np.full(len(arrays["image"]), draw, dtype=np.int32), **arrays}
    if path.exists():
        with np.load(path) as old:
            kept = old["draw"] != draw
            new = {k: np.concatenate((old[k][kept], v)) for k, v in new.items()}
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez_compressed(file, **new)  # type: ignore[arg-type]  # numpy types **kwds with its own flag
    part.replace(path)


def sample(data: Path, out: Path, draws: int) -> list[Row]:
    """Copies what a trained surrogate is judged by: the obstacle course's inputs and sections.

    Args:
        data: Folder of ``runs``.
        out: Folder of the copies; must be there.
        draws: Of each centre path, from the first.

    Returns:
        Centre path, beads, sections and bytes of each copy.

    Raises:
        ConfigError: If there is no run of the obstacle course.
    """
    rows: list[Row] = []
    for centre in paths.VALIDATION:
        file, copy = data / f"{centre.name}.npz", out / f"{centre.name}.npz"
        if not file.exists():
            continue
        with np.load(file, allow_pickle=False) as all_of_it:
            kept = all_of_it["draw"] < draws
            arrays = {k: all_of_it[k][kept] for k in ("draw", *INPUTS, "image")}
        np.savez_compressed(copy, **arrays)
        beads = len(np.unique(arrays["draw"]))
        size = copy.stat().st_size
        rows.append({"path": centre.name, "beads": beads, "sections": int(kept.sum()), "bytes": size})
    require(bool(rows), f"{data} holds no run of the obstacle course: make some with `laydown runs`")
    return rows


def summary(rows: list[Row]) -> list[Row]:
    """One row for each centre path.

    Args:
        rows: Of the runs.

    Returns:
        Counts and means of what is of use.
    """
    table = []
    for name in CENTRE_PATHS:
        mine = [r for r in rows if r["path"] == name]
        good = [r for r in mine if r["error"] is None]
        table.append(
            {
                "path": name,
                "set": "training" if name in {p.name for p in paths.TRAINING} else "validation",
                "runs": len(mine),
                "failed": len(mine) - len(good),
                "sections": sum(r["sections"] for r in good),
                "volume_error_pct": 100.0 * max((abs(r["volume_error"]) for r in good), default=0.0),
                "cpu_s": float(np.mean([r["cpu_s"] for r in good])) if good else None,
            }
        )
    return table


def markdown(table: list[Row]) -> str:
    """The table for people.

    Args:
        table: From ``summary``.

    Returns:
        Markdown.
    """
    head = ["centre path", "set", "runs", "failed", "sections", "largest volume error %", "CPU s a run"]
    body = [
        [
            r["path"],
            r["set"],
            str(r["runs"]),
            str(r["failed"]),
            str(r["sections"]),
            results.number(r["volume_error_pct"], 2),
            results.number(r["cpu_s"], 0),
        ]
        for r in table
    ]
    return results.grid(head, body)
