"""Table 3: direct control, neural RMP and what they are measured against, on parts that stand still.

    python -m experiments.table3 --trials 100 --seed 1000000 --jobs 2 --out experiments/results

Flat, cylinder and the unseen rectangular part for every method and training seed; then seams of other shape.
Writes table3.json, .csv, .md, table3_paired.csv, table3_paths.npz (the tip's path in the first trials of each
cell) and figures. Batches are logged as they end: the same command goes on where it was stopped.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import agents
from agents.policies import KINDS, read_card
from experiments import results, shapes, table3_figures, table3_report, trials
from experiments.table3_report import METHODS
from experiments.trials import Row, Trial
from seal_gym.core.errors import ConfigError, SealGymError, require
from seal_gym.envs.config import PERCEPTIONS
from seal_gym.workpieces import catalogue

NAME = "table3"
TRAINING_SEEDS = (0, 1, 2)
SHAPE_TRIALS = 25
PATHS = 5  # trials of a cell whose paths are kept and drawn
_DAGGER = "_dagger"


class Weights(NamedTuple):
    """The weights of a learned policy.

    Attributes:
        method: Name of the policy.
        training_seed: From the card.
        file: ``NAME.safetensors``.
        sha256: Of the file, from the card.
    """

    method: str
    training_seed: int
    file: Path
    sha256: str


class Plan(NamedTuple):
    """What to run.

    Attributes:
        main: The shipped policies on the nominal parts.
        seeds: Every training seed on the nominal parts, the shipped ones among them.
        other: The shipped policies on the other shapes.
        weights: Of all learned policies.
    """

    main: list[Trial]
    seeds: list[Trial]
    other: list[Trial]
    weights: list[Weights]


def is_learned(method: str) -> bool:
    """Whether a policy has weights.

    Args:
        method: Its name.

    Returns:
        Whether it does.
    """
    return method.removesuffix(_DAGGER) in KINDS


def how_to_train(method: str) -> str:
    """The commands that make a policy's weights.

    Args:
        method: Its name.

    Returns:
        For a shell.
    """
    kind = method.removesuffix(_DAGGER)
    dagger = " --dagger 3 --dagger-episodes 50 --dagger-epochs 6" if method.endswith(_DAGGER) else ""
    return (
        "python -m agents.collect --episodes 2400 --jobs 2 --out DATA; "
        f"python -m agents.train_bc --policy {kind}{dagger} --seed S --data DATA --out RUN --validate 20"
    )


def find_weights(folder: Path, method: str, training_seeds: Sequence[int]) -> tuple[list[Weights], list[str]]:
    """The shipped weights of a method, then those of its training seeds.

    Args:
        folder: With ``METHOD.safetensors`` and ``METHOD-seedS.safetensors``.
        method: Its name.
        training_seeds: That must be there; of what DAgger trained, those that are there are enough.

    Returns:
        The weights, the shipped first and each seed once; and the names of files that are missing.

    Raises:
        PolicyFileError: If a card is damaged.
        ConfigError: If the shipped weights are not those of the seed on their card.
    """
    shipped, missing = folder / f"{method}.safetensors", []
    files = [folder / f"{method}-seed{seed}.safetensors" for seed in training_seeds]
    if method.endswith(_DAGGER):
        files = [file for file in files if file.is_file()]
    missing = [file.name for file in (shipped, *files) if not file.is_file()]
    if missing:
        return [], missing
    found: list[Weights] = []
    for file in (shipped, *files):
        card = read_card(file)
        new = Weights(method, int(card["seed"]), file, str(card["sha256"]))
        if found and new.training_seed == found[0].training_seed:
            require(
                new.sha256 == found[0].sha256,
                f"{shipped.name} and {file.name} are both of training seed {new.training_seed}, but differ: "
                "copy them again with agents.ship",
            )
            continue
        found.append(new)
    return found, []


def check_methods(methods: Sequence[str], folder: Path, training_seeds: Sequence[int]) -> list[Weights]:
    """Finds the weights of all methods before anything runs.

    Args:
        methods: Names of the policies.
        folder: With the weights.
        training_seeds: That each kind of ``KINDS`` must have.

    Returns:
        Weights of the learned ones.

    Raises:
        ConfigError: If a policy is unknown or has no weights: what to do about each.
    """
    problems, weights = [], []
    for method in methods:
        if method not in agents.POLICIES:
            problems.append(f"{method}: no policy of that name, agents has {sorted(agents.POLICIES)}")
        elif is_learned(method):
            found, missing = find_weights(folder, method, training_seeds)
            weights += found
            if missing:
                problems.append(f"{method}: {', '.join(missing)} missing; train: {how_to_train(method)}")
    if problems:
        lines = "\n  ".join(problems)
        raise ConfigError(
            f"in {folder}:\n  {lines}\n  then agents.ship copies the seeds; or name the methods to "
            "run with --method (and their --training-seeds)"
        )
    return weights


def plan(options: argparse.Namespace) -> Plan:
    """The trials of the table.

    Args:
        options: The command line.

    Returns:
        What to run.

    Raises:
        ConfigError: See ``check_methods``.
    """
    methods = list(dict.fromkeys(options.method or METHODS))
    weights = check_methods(methods, options.weights, options.training_seeds)
    env = {"perception": options.perception, "renderer": "raycast"}

    def cell(method: str, part: str, count: int, of: Weights | None) -> list[Trial]:
        file, training_seed = (str(of.file), of.training_seed) if of else (None, None)
        return [
            Trial(
                method=method,
                workpiece=part,
                seed=options.seed + k,
                env=env,
                weights=file,
                training_seed=training_seed,
            )
            for k in range(count)
        ]

    by_method = {m: [w for w in weights if w.method == m] for m in methods}
    shipped = {m: w[0] if w else None for m, w in by_method.items()}
    chosen = list(dict.fromkeys(options.workpiece or (*catalogue.NAMES, *shapes.NAMES)))
    nominal, other = ([p for p in chosen if (p in catalogue.NAMES) is which] for which in (True, False))
    seeds = [
        t
        for m in methods
        if len(by_method[m]) > 1
        for p in nominal
        for w in sorted(by_method[m], key=lambda w: w.training_seed)
        for t in cell(m, p, options.trials, w)
    ]
    return Plan(
        [t for m in methods for p in nominal for t in cell(m, p, options.trials, shipped[m])],
        seeds,
        [t for m in methods for p in other for t in cell(m, p, options.shape_trials, shipped[m])],
        weights,
    )


def run(what: Plan, *, jobs: int, log: Path) -> tuple[list[Row], list[Row], list[Row]]:
    """Runs the plan, each trial once.

    Args:
        what: The plan.
        jobs: Processes.
        log: See ``trials.run_all``.

    Returns:
        Rows of ``main``, ``seeds`` and ``other``, with ``path_mm``.
    """
    groups = (what.main, what.seeds, what.other)
    wanted = {_identity(t): t for group in groups for t in group}
    rows = trials.run_all(wanted.values(), jobs=jobs, log=log, title="sealing", together=trials.TOGETHER)
    ran = dict(zip(wanted, rows, strict=True))
    main, seeds, other = ([ran[_identity(t)] for t in group] for group in groups)
    return main, seeds, other


def _identity(t: Trial) -> tuple[str, int | None, str, int]:
    return t.method, t.training_seed, t.workpiece, t.seed


def first_paths(rows: Sequence[Row]) -> dict[str, Any]:
    """The tip's paths in the first trials of each cell.

    Args:
        rows: Of trials, with ``path_mm``.

    Returns:
        By ``method/workpiece/seed``, shape (samples, 3), mm, float32.
    """
    out: dict[str, Any] = {}
    seen: dict[tuple[str, str], int] = {}
    for row in rows:
        cell = (row["method"], row["workpiece"])
        seen[cell] = seen.get(cell, 0) + 1
        if seen[cell] <= PATHS:
            name = table3_figures.path_name(row)
            out[name] = np.asarray(row["path_mm"], dtype=np.float32)
    return out


def write(what: Plan, ran: tuple[list[Row], list[Row], list[Row]], options: argparse.Namespace) -> str:
    """Writes the files.

    Args:
        what: The plan.
        ran: From ``run``.
        options: The command line.

    Returns:
        The main table for people.
    """
    main, seeds, other = ran
    out: Path = options.out
    rows = table3_report.summarise(main, seeds, other)
    spreads = table3_report.spread(rows)
    pairs = table3_report.paired([*main, *other])
    shipped = {(row["method"], row["training_seed"]) for row in main}
    seeds_alone = [row for row in seeds if (row["method"], row["training_seed"]) not in shipped]
    all_rows = [{k: v for k, v in row.items() if k != "path_mm"} for row in (*main, *seeds_alone, *other)]
    environments, light = trials.shared(all_rows)
    np.savez_compressed(out / f"{NAME}_paths.npz", **first_paths([*main, *other]))
    results.write(
        out,
        NAME,
        rows,
        light,
        renderer="raycast" if options.perception == "vision" else "none",
        regime="static",
        text=table3_report.markdown(rows, spreads, pairs, table3_figures.names(rows)),
        more={
            "paired": pairs,
            "spread": spreads,
            "policies": [{**w._asdict(), "file": w.file.name} for w in what.weights],
            "environments": environments,
        },
    )
    if pairs:
        results.write_csv(out / f"{NAME}_paired.csv", pairs)
    redraw(out)
    return results.table(table3_report.of_table(rows, "main") or rows)


def redraw(out: Path) -> None:
    """Draws the figures of a table from its files.

    Args:
        out: Its folder.

    Raises:
        ConfigError: If there is no table.
    """
    file, paths = out / f"{NAME}.json", out / f"{NAME}_paths.npz"
    require(file.is_file() and paths.is_file(), f"{file} or {paths.name} not found: run the table first")
    with np.load(paths, allow_pickle=False) as arrays:
        table3_figures.draw(out, json.loads(file.read_text(encoding="utf-8")), arrays)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.table3", description=__doc__.splitlines()[0].removeprefix("Table 3: ")
    )
    parser.add_argument(
        "--method",
        action="append",
        choices=sorted({*METHODS, *agents.POLICIES}),
        help="may be repeated (default: all of the table)",
    )
    parser.add_argument(
        "--workpiece",
        action="append",
        choices=(*catalogue.NAMES, *shapes.NAMES),
        help="a nominal part or a shape; may be repeated (default: all)",
    )
    parser.add_argument("--trials", type=int, default=1, help="a nominal part (default: %(default)s)")
    parser.add_argument(
        "--shape-trials", type=int, help=f"a shape (default: as --trials, at most {SHAPE_TRIALS})"
    )
    parser.add_argument("--seed", type=int, default=500_000, help="of the first trial (default: %(default)s)")
    parser.add_argument(
        "--training-seeds",
        type=int,
        nargs="*",
        default=list(TRAINING_SEEDS),
        metavar="S",
        help="that get rows of their own beside the shipped one (default: 0 1 2)",
    )
    parser.add_argument(
        "--weights", type=Path, default=agents.WEIGHTS, help="folder of the weights (default: the shipped)"
    )
    parser.add_argument("--perception", default=PERCEPTIONS[0], choices=PERCEPTIONS)
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/table3"), help="folder (default: %(default)s)")
    parser.add_argument("--redraw", action="store_true", help="draw the figures of a table in OUT again")
    options = parser.parse_args(arguments)
    if options.shape_trials is None:
        options.shape_trials = min(options.trials, SHAPE_TRIALS)
    for name, least in (("trials", 1), ("shape_trials", 1), ("jobs", 1), ("seed", 0)):
        if getattr(options, name) < least:
            parser.error(f"--{name.replace('_', '-')} {getattr(options, name)}: must be at least {least}")
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"--out {options.out}: is a file, must be a folder")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Makes the table.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    try:
        if options.redraw:
            redraw(options.out)
            return 0
        what = plan(options)
        options.out.mkdir(parents=True, exist_ok=True)
        last = options.seed + max(options.trials, options.shape_trials) - 1
        results.log_run(NAME, "Table 3", last)
        ran = run(what, jobs=options.jobs, log=options.out / f"{NAME}.trials.jsonl")
        text = write(what, ran, options)
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    print(f"\n{text}\n\nwritten to {options.out}/")
    return 0


if __name__ == "__main__":
    sys.exit(main())
