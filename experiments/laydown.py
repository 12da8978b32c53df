"""The laydown reference: a grid study, runs over named substrates, and the cross-sections that they give.

``python -m experiments.laydown grid`` compares cell sizes and solvers on a straight bead; ``runs`` computes the
simulations of the data set, one after another and none twice; ``sections`` writes the data set from them.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments import command, laydown_report, results
from seal_gym.core.frames import Array
from seal_gym.sealant.laydown import paths, run, sections
from seal_gym.sealant.laydown.config import LaydownCfg, LaydownError
from seal_gym.sealant.laydown.paths import TRAINING, VALIDATION, CentrePath

_CELLS_MM = (2.0, 1.5, 1.0, 0.75, 0.5)
_END_M = 10e-3  # of a path, where the bead begins and ends: not used as cross-sections
_CLEARANCE_M = (4e-3, 16e-3)
_STRAIGHT = CentrePath(name="straight", substrate="plane", legs=((40e-3, 0.0),))
_STRAIGHT_DRAWS = np.tile([30e-3, 0.3, 0.0, 0.0, 0.0], (2, 1))
_WORST_VOLUME = 5e-3
_SECTION_KEYS = ("linear_mps", "angular_radps", "gravity_mps2", "heights_m", "arcs_m", "ideal_m2")


@dataclass(frozen=True)
class Job:
    """One simulation of the data set.

    Attributes:
        split: ``"training"`` or ``"validation"``.
        centre: The centre path.
        number: Of the centre path within its split.
        draw: Number of the random draw.
    """

    split: str
    centre: CentrePath
    number: int
    draw: int

    @property
    def name(self) -> str:
        """File name."""
        return f"{self.centre.name}.{self.draw}"

    def cfg(self, seed: int, cell_m: float, solver: str) -> LaydownCfg:
        """The simulation.

        Args:
            seed: Of the data set.
            cell_m: Edge of a cell [m].
            solver: OpenFOAM's program.

        Returns:
            With a mesh as high as the bead needs.
        """
        rng = np.random.default_rng([seed, self.split == "validation", self.number, self.draw])
        cfg = LaydownCfg(
            path=paths.random_tip_path(self.centre, rng),
            substrate=self.centre.substrate,
            gravity_mps2=self.centre.gravity_mps2,
        )
        return _with_grid(cfg, cell_m, solver)


def _with_grid(cfg: LaydownCfg, cell_m: float, solver: str) -> LaydownCfg:
    clearance = float(np.clip(1.3 * run.expected_peak_m(cfg) + 2.5e-3, *_CLEARANCE_M))
    clearance = (
        math.ceil(clearance / 2e-3 - 1e-9) * 2e-3
    )  # the same box for every cell size of the grid study
    grid = replace(cfg.grid, cell_m=cell_m, solver=solver, clearance_m=clearance)
    return replace(cfg, grid=grid)


def jobs(draws: int, validation_draws: int) -> list[Job]:
    """The data set's simulations, draw by draw.

    Args:
        draws: For each training path.
        validation_draws: For each validation path.

    Returns:
        Jobs; those of the first draw come first.
    """
    wanted = [Job("training", c, k, d) for d in range(draws) for k, c in enumerate(TRAINING)]
    wanted += [Job("validation", c, k, d) for d in range(validation_draws) for k, c in enumerate(VALIDATION)]
    return sorted(wanted, key=lambda job: job.draw)


def _one(job: Job, options: argparse.Namespace) -> str | None:
    """Computes a run if it is not there; the reason if it cannot be done."""
    file = options.out / "runs" / f"{job.split}.{job.name}.npz"
    failed = file.with_suffix(".failed")
    if file.exists():
        return None
    try:
        cfg = job.cfg(options.seed, options.cell * 1e-3, options.solver)
        at = sections.stations(cfg)
        bead = run.simulate(cfg, options.out / "cases" / f"{job.split}.{job.name}", limit_s=options.limit)
    except LaydownError as error:
        failed.write_text(f"{error}\n", encoding="utf-8")
        return f"{job.name}: {str(error).splitlines()[0]}"
    failed.unlink(missing_ok=True)
    arrays = {key: getattr(at, key).astype(np.float32) for key in _SECTION_KEYS}
    arrays |= {"hits_m": at.hits.astype(np.float32)}
    for frame, rotation in (("tip", at.tips), ("across", at.across)):
        images = sections.cut(bead.mesh, bead.fractions, at.hits, rotation)
        arrays[f"images_{frame}"] = np.round(255.0 * images).astype(np.uint8)
    ids = bead.mesh.cell_ids
    whole = np.where(ids >= 0, np.clip(bead.fractions, 0, 1)[ids], 0.0)
    facts = {
        "centre_path": job.centre.name,
        "substrate": job.centre.substrate,
        "split": job.split,
        "draw": job.draw,
        "cells": len(bead.fractions),
        "cell_mm": options.cell,
        "solver": options.solver,
        "volume_error": bead.volume_error,
        "lid_fraction": bead.lid_fraction,
        "cpu_s": round(bead.cpu_s, 2),
        "path_s": round(float(cfg.path.times_s[-1]), 4),
    }
    part = file.with_suffix(".part.npz")
    np.savez_compressed(
        part,
        facts=np.array(json.dumps(facts)),
        bead=np.round(255.0 * whole).astype(np.uint8),
        solid=np.packbits(ids < 0),
        origin=bead.mesh.origin,
        **arrays,
    )
    part.replace(file)
    return None


def do_runs(options: argparse.Namespace) -> str:
    """Computes what is missing of the data set's simulations.

    Args:
        options: Of the command line.

    Returns:
        The report.
    """
    wanted = jobs(options.draws, options.validation_draws)
    (options.out / "runs").mkdir(parents=True, exist_ok=True)
    bad = []
    with ThreadPoolExecutor(options.jobs) as pool:
        done: Iterable[str | None] = pool.map(lambda job: _one(job, options), wanted)
        for reason in tqdm(done, total=len(wanted), desc="laying beads", unit="run"):
            if reason:
                bad.append(reason)
    lines = [f"{len(wanted) - len(bad)} of {len(wanted)} runs are complete", *bad]
    return "\n".join(lines)


def load(options: argparse.Namespace) -> list[tuple[Job, dict[str, Any], dict[str, Array]]]:
    """Reads the complete runs.

    Args:
        options: Of the command line.

    Returns:
        Job, facts and arrays of each.

    Raises:
        LaydownError: If there are none.
    """
    found = []
    for job in jobs(options.draws, options.validation_draws):
        file = options.out / "runs" / f"{job.split}.{job.name}.npz"
        if file.exists():
            with np.load(file) as data:
                arrays = {key: data[key] for key in data.files}
            found.append((job, json.loads(str(arrays.pop("facts"))), arrays))
    if not found:
        raise LaydownError(f"{options.out / 'runs'} holds no runs: python -m experiments.laydown runs")
    return found


def do_sections(options: argparse.Namespace) -> str:
    """Writes the data set from the complete runs.

    Args:
        options: Of the command line.

    Returns:
        The report.
    """
    found = load(options)
    rows = []
    columns: dict[str, dict[str, list[Any]]] = {"training": {}, "validation": {}}
    for job, facts, arrays in found:
        arcs = arrays["arcs_m"]
        inner = (arcs >= _END_M) & (arcs <= arcs[-1] - _END_M)
        images = arrays["images_across"][inner] / 255.0
        area, ideal = sections.area_m2(images), arrays["ideal_m2"][inner]
        complete = abs(facts["volume_error"]) <= _WORST_VOLUME and facts["lid_fraction"] < 0.5
        rows.append(
            facts
            | {
                "sections": int(inner.sum()) if complete else 0,
                "area_mm2": 1e6 * float(area.mean()),
                "ideal_area_mm2": 1e6 * float(ideal.mean()),
                "width_mm": 1e3 * float(sections.width_m(images).mean()),
                "height_mm": 1e3 * float(sections.height_m(images).mean()),
            }
        )
        if not complete:
            continue
        split = columns[job.split]
        kept = {key: arrays[key] for key in (*_SECTION_KEYS, "images_tip", "images_across")}
        n = len(arcs)
        kept |= {
            "inner": inner,
            "centre_path": np.full(n, job.number, dtype=np.uint8),
            "draw": np.full(n, job.draw, dtype=np.uint8),
        }
        for key, values in kept.items():
            split.setdefault(key, []).append(values)
    sizes = []
    for name, centres in (("training", TRAINING), ("validation", VALIDATION)):
        if columns[name]:
            arrays = {key: np.concatenate(parts) for key, parts in columns[name].items()}
            arrays["centre_path_names"] = np.array([c.name for c in centres])
            file = options.out / f"laydown_{name}.npz"
            np.savez_compressed(file, **arrays)
            n = f"{int(arrays['inner'].sum())} sections inside {len(arrays['inner'])} stations"
            sizes.append(f"{name}: {n}, {file.stat().st_size / 1e6:.2f} MB")
    laydown_report.gallery(options.out / "laydown_runs.png", found)
    laydown_report.atlas(options.out / "laydown_sections.png", found)
    table = laydown_report.runs_table(rows)
    results.write(
        options.out,
        "laydown_runs",
        rows,
        [],
        renderer="none",
        regime="static",
        text=table,
        more={"seed": options.seed},
        module="laydown",
    )
    return "\n".join([table, "", *sizes])


def grid_cfg(cell_mm: float, solver: str) -> LaydownCfg:
    """A straight bead on a plane.

    Args:
        cell_mm: Edge of a cell [mm].
        solver: OpenFOAM's program.

    Returns:
        40 mm of it at 0.3 m/s, 30 mm above the plane.
    """
    return _with_grid(LaydownCfg(path=paths.tip_path(_STRAIGHT, _STRAIGHT_DRAWS)), cell_mm * 1e-3, solver)


def do_grid(options: argparse.Namespace) -> str:
    """Compares cell sizes and solvers.

    Args:
        options: Of the command line.

    Returns:
        The report.
    """
    folder = options.out / "grid"
    folder.mkdir(parents=True, exist_ok=True)
    found: dict[tuple[str, float], tuple[Array, dict[str, Any]]] = {}
    wanted = [(cell, solver) for cell in options.cells for solver in ("interFoam", "interIsoFoam")]
    for cell, solver in tqdm(wanted, desc="grids", unit="run"):
        file = folder / f"{solver}.{cell:g}.npz"
        if not file.exists():
            cfg = grid_cfg(cell, solver)
            at = sections.stations(cfg)
            bead = run.simulate(cfg, folder / f"{solver}.{cell:g}", limit_s=options.limit)
            images = sections.cut(bead.mesh, bead.fractions, at.hits, at.across)
            facts = {
                "cells": len(bead.fractions),
                "volume_error": bead.volume_error,
                "cpu_s": round(bead.cpu_s, 1),
                "ideal_mm2": 1e6 * float(at.ideal_m2[0]),
            }
            np.savez_compressed(file, images=images, arcs_m=at.arcs_m, facts=np.array(json.dumps(facts)))
        with np.load(file) as data:
            arcs = data["arcs_m"]
            inner = (arcs >= _END_M) & (arcs <= arcs[-1] - _END_M)
            found[solver, cell] = data["images"][inner], json.loads(str(data["facts"]))
    rows = laydown_report.grid_rows(found)
    text = laydown_report.grid_table(rows)
    results.write(
        options.out, "laydown_grid", rows, [], renderer="none", regime="static", text=text, module="laydown"
    )
    laydown_report.grid_picture(options.out / "laydown_grid.png", found)
    return text


def main(arguments: list[str] | None = None) -> int:
    """Runs the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status.
    """
    parser = argparse.ArgumentParser(prog="python -m experiments.laydown", description=__doc__)
    parser.add_argument("what", choices=("grid", "runs", "sections"))
    parser.add_argument("--draws", type=int, default=4, help="of each training path (default: %(default)s)")
    parser.add_argument(
        "--validation-draws", type=int, default=1, help="of each validation path (default: %(default)s)"
    )
    parser.add_argument("--cell", type=float, default=1.0, help="of the runs, mm (default: %(default)s)")
    parser.add_argument(
        "--cells",
        type=float,
        nargs="+",
        default=_CELLS_MM,
        help="of the grid study, mm (default: %(default)s)",
    )
    parser.add_argument(
        "--solver", default="interFoam", choices=("interFoam", "interIsoFoam"), help="of the runs"
    )
    parser.add_argument(
        "--limit", type=float, default=3600.0, help="time for each run, s (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the draws (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/laydown"), help="folder (default: %(default)s)")
    options = command.checked(parser, arguments, draws=1, validation_draws=0, jobs=1, seed=0)
    work = {"grid": do_grid, "runs": do_runs, "sections": do_sections}[options.what]
    return command.run(lambda: work(options), options.out)


if __name__ == "__main__":
    sys.exit(main())
