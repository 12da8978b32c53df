"""What the experiments' command lines share."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from agents import engines
from experiments import results, trials
from experiments.trials import Row, Trial, Worker
from seal_gym.core.errors import SealGymError
from seal_gym.envs.config import PERCEPTIONS, RENDERERS
from seal_gym.workpieces.catalogue import NAMES


def checked(parser: argparse.ArgumentParser, arguments: list[str] | None, **least: int) -> argparse.Namespace:
    """Reads a command line; ends the program with a word on what is out of range.

    Args:
        parser: With an ``--out``.
        arguments: Without the program's name; the process's own by default.
        **least: Smallest value of options that are numbers.

    Returns:
        The options.
    """
    options = parser.parse_args(arguments)
    for name, low in least.items():
        if getattr(options, name) < low:
            parser.error(f"--{name.replace('_', '-')} {getattr(options, name)}: must be at least {low}")
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"--out {options.out}: is a file, must be a folder")
    return options


def add_run(parser: argparse.ArgumentParser, out: str) -> None:
    """Adds the options of a command that looks closely at one run.

    Args:
        parser: The command line.
        out: The default folder.
    """
    parser.add_argument("--workpiece", default="rectangular", choices=NAMES, help="(default: %(default)s)")
    parser.add_argument(
        "--seam", type=Path, help="a seam of yours instead: CSV with rows x,y,z,ax,ay,az in m"
    )
    parser.add_argument("--perception", default="vision", choices=PERCEPTIONS, help="(default: %(default)s)")
    parser.add_argument("--renderer", default=RENDERERS[0], choices=RENDERERS, help="of the sensor images")
    parser.add_argument("--seed", type=int, default=500_000, help="of the run (default: %(default)s)")
    parser.add_argument(
        "--every",
        type=int,
        default=2,
        help="record each n-th frame's images and arrows (default: %(default)s)",
    )
    parser.add_argument("--out", type=Path, default=Path(out), help="folder (default: %(default)s)")


def add_trials(parser: argparse.ArgumentParser, name: str, each: str, severity: str) -> None:
    """Adds the options of a command that runs disturbed trials on the nominal parts.

    Args:
        parser: The command line.
        name: Of the experiment.
        each: What gets so many trials.
        severity: What ``--severity`` means.
    """
    parser.add_argument("--workpiece", action="append", choices=NAMES, help="may be repeated (default: all)")
    parser.add_argument("--trials", type=int, default=1, help=f"of each {each} (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=500_000, help="of the first trial (default: %(default)s)")
    parser.add_argument("--severity", type=float, default=1.0, help=f"{severity} (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / name, help="folder (default: %(default)s)")


def checked_trials(parser: argparse.ArgumentParser, arguments: list[str] | None) -> argparse.Namespace:
    """Reads a command line with the options of ``add_trials``; see ``checked``.

    Args:
        parser: The command line.
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    options = checked(parser, arguments, trials=1, jobs=1, seed=0)
    if not 0.0 < options.severity <= 20.0:
        parser.error(f"--severity {options.severity}: must be in (0, 20]")
    return options


def run_trials(
    name: str,
    wanted: list[Trial],
    work: Worker,
    write: Callable[[list[Row], argparse.Namespace], str],
    options: argparse.Namespace,
) -> int:
    """Runs the trials of a command, logged as they end, and writes what came of them.

    Args:
        name: Of the experiment.
        wanted: The trials.
        work: Runs one.
        write: Writes the files from all rows, gives the report.
        options: With those of ``add_trials``.

    Returns:
        Exit status, see ``run``.
    """

    def do() -> str:
        results.log_run(name, name.capitalize(), options.seed + options.trials - 1)
        log, engine = options.out / f"{name}.trials.jsonl", engines.local(options.jobs)
        return write(trials.run_all(wanted, engine=engine, log=log, title="sealing", work=work), options)

    return run(do, options.out)


def run(work: Callable[[], str], out: Path) -> int:
    """Does a command's work and prints what came of it.

    Args:
        work: Writes the files, gives the report.
        out: Their folder; made if need be.

    Returns:
        Exit status: 2 if it could not be done, with the reason on the standard error.
    """
    out.mkdir(parents=True, exist_ok=True)
    try:
        text = work()
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    sys.stdout.write(f"\n{text}\n\nwritten to {out}/\n")
    return 0
