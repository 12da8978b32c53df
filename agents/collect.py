"""Collects demonstrations: the disturbed expert on flat and cylinder, seen through vision.

    python -m agents.collect --episodes 2400 --jobs 2 --out out/demos

Each episode is written as it ends. Killed at any moment and started again with the same command, it goes on
where it stopped, having lost at most the episode each job was on, and ends with the same data to the bit,
whatever the number of jobs, the batch or the engine.
"""

import argparse
import fcntl
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gymnasium import spaces
from tqdm import tqdm

from agents import demos, engines, episodes
from agents.engines import Engine
from agents.episodes import FIRST_VALIDATION_SEED, CollectCfg, Work
from agents.provenance import code_hash, commit, stack
from seal_gym.core.errors import ConfigError, SealGymError, require
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.sim.look import LookCfg
from seal_gym.tasks.progress import SealTaskCfg

_PLAN = "collect.json"
_SAME = ("seed", "config", "code", "stack")  # what a collection must have in common with its continuation
DATASET_ID = "seal_gym/demonstrations-v0"


# -- what is collected ----------------------------------------------------------------------------------


def plan(count: int, seed: int, cfg: CollectCfg) -> dict[str, Any]:
    """All that decides a collection, and where it comes from.

    Args:
        count: Number of episodes.
        seed: Seed of episode 0.
        cfg: The randomisation.

    Returns:
        Ready for JSON.

    Raises:
        ConfigError: If the seeds leave the training range.
    """
    require(count >= 1, f"--episodes {count}: must be at least 1")
    require(
        seed >= 0 and seed + count <= FIRST_VALIDATION_SEED,
        f"--seed {seed} with --episodes {count}: training seeds are 0..{FIRST_VALIDATION_SEED - 1}; choose a "
        "lower seed",
    )
    wide = " --wide" if cfg == CollectCfg.wide() else ""
    config = {
        "collect": asdict(cfg),
        "look": asdict(LookCfg()),
        "task": asdict(SealTaskCfg()),
        "perception": "vision",
    }
    return {
        "command": f"python -m agents.collect --episodes {count} --seed {seed}{wide}",
        "episodes": count,
        "seed": seed,
        "config": json.loads(json.dumps(config)),  # tuples as JSON has them, to compare
        "stack": stack(),
        "code": code_hash(),
        "git_commit": commit(),
    }


def works(missing: list[int], batch: int, seed: int, cfg: CollectCfg) -> list[Work]:
    """Splits episodes into units of one part each.

    Args:
        missing: Numbers of the episodes to run.
        batch: Episodes in a unit.
        seed: Seed of episode 0.
        cfg: The randomisation.

    Returns:
        The units, by their first episode.
    """
    units = []
    for part in dict.fromkeys(cfg.workpieces):
        mine = [k for k in missing if episodes.part_of(k, cfg) == part]
        units += [
            Work(indices=tuple(mine[i : i + batch]), seed=seed, cfg=cfg) for i in range(0, len(mine), batch)
        ]
    return sorted(units, key=lambda w: w.indices)


# -- the collection -------------------------------------------------------------------------------------


def _minari(meta: dict[str, Any]) -> dict[str, Any]:
    """Minari's own entries in the dataset's metadata."""
    from minari import __version__ as minari_version  # with typer and pydantic: only when it is needed
    from minari.serialization import serialize_space

    core = SealCore(SealCfg.of(workpiece=meta["config"]["collect"]["workpieces"][0], perception="oracle"), 1)
    action = spaces.Dict({k: spaces.Box(-1.0, 1.0, (n,)) for k, n in demos.SIZES.items()})
    return {
        "observation_space": serialize_space(core.observation_space),
        "action_space": serialize_space(action),
        "dataset_id": DATASET_ID,
        "minari_version": minari_version,
        "algorithm_name": "rmp_expert, disturbed",
        "description": "Robot sealing on flat and cylinder. Actions are the undisturbed expert's at each "
        "state, in both action spaces; the motion is that of the disturbed gun (infos: offset).",
    }


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Holds a folder for one collection at a time; the lock ends with the process, however it ends."""
    folder = os.open(out, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError:
        raise ConfigError(f"--out {out}: another collection is writing there; wait for it") from None
    finally:
        os.close(folder)


def _begin(out: Path, wanted: dict[str, Any]) -> dict[str, Any]:
    """Starts a collection, or checks that this is the one that was started here."""
    path = out / _PLAN
    if not path.exists():
        others = sorted(f.name for f in out.iterdir() if not f.name.startswith(f".{_PLAN}"))
        require(not others, f"--out {out}: holds {others[:3]} but no {_PLAN}: choose an empty folder")
        demos.write_json(path, wanted)
        return wanted
    begun, _ = demos.read_json(path)
    for key in _SAME:
        require(
            begun.get(key) == wanted[key],
            f"--out {out}: was begun with {key} = {begun.get(key)!r}, now it is {wanted[key]!r}: choose "
            f"another folder, or go back to what it was (commit {begun.get('git_commit')})",
        )
    require(
        int(begun["episodes"]) <= wanted["episodes"],
        f"--episodes {wanted['episodes']}: {out} was begun with {begun['episodes']}: give as many or more",
    )
    if begun["episodes"] != wanted["episodes"]:  # more than before: the ones there are the same
        (out / "data" / "metadata.json").unlink(missing_ok=True)
        begun |= {key: wanted[key] for key in ("episodes", "command")}
        demos.write_json(path, begun)
    return begun


def collect(out: Path, wanted: dict[str, Any], cfg: CollectCfg, engine: Engine, batch: int = 1) -> int:
    """Runs the episodes that are not there yet and makes a dataset of all.

    Args:
        out: The folder; made if need be.
        wanted: From ``plan``.
        cfg: The randomisation in it.
        engine: Runs the units.
        batch: Episodes in a unit.

    Returns:
        Number of steps in the dataset.

    Raises:
        ConfigError: If the folder holds something else.
    """
    data = out / "data"
    out.mkdir(parents=True, exist_ok=True)
    with _locked(out):
        meta = _begin(out, wanted)
        data.mkdir(exist_ok=True)
        count = wanted["episodes"]
        missing = [k for k in range(count) if not demos.has_episode(data, k)]
        bar = tqdm(total=count, initial=count - len(missing), desc="collect", unit="episode", smoothing=0.1)
        steps = 0
        with bar:
            for _, done in engine(episodes.run, works(missing, batch, meta["seed"], cfg)):
                for episode in done:
                    demos.write_episode(data, episode)
                    steps += len(episode.rewards)
                bar.update(len(done))
                bar.set_postfix(steps=steps)
        return demos.finish(data, count, _minari(meta), meta)


def _whole(low: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < low:
            raise argparse.ArgumentTypeError(f"{text!r}: must be a whole number, at least {low}")
        return int(text)

    return parse


def parser() -> argparse.ArgumentParser:
    """The command line.

    Returns:
        Its parser.
    """
    p = argparse.ArgumentParser(
        prog="python -m agents.collect",
        description="Collects demonstrations of the disturbed expert on flat and cylinder (Zhou et al. 4.2). "
        "Start it again with the same arguments to go on after a stop.",
    )
    p.add_argument("--episodes", type=_whole(1), default=2400, help="number of episodes (default: 2400)")
    p.add_argument("--jobs", type=_whole(1), default=1, help="processes (default: 1)")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the dataset")
    p.add_argument("--seed", type=_whole(0), default=0, help="seed of episode 0; episode k has seed + k")
    p.add_argument(
        "--batch",
        type=_whole(1),
        default=1,
        help="episodes that a job runs side by side: more is faster, and a kill loses as many (default: 1)",
    )
    engines.add_options(p)
    p.add_argument(
        "--wide",
        action="store_true",
        help="beyond the paper: rotation rates up to 40 deg/s, not 10, for larger heading errors",
    )
    return p


def main(arguments: list[str] | None = None) -> int:
    """Runs the command line.

    Args:
        arguments: Of the command, by default the process's.

    Returns:
        The exit status.
    """
    args = parser().parse_args(arguments)
    cfg = CollectCfg.wide() if args.wide else CollectCfg()
    try:
        wanted = plan(args.episodes, args.seed, cfg)
        steps = collect(args.out, wanted, cfg, engines.of(args, code_hash), args.batch)
    except SealGymError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped; start the same command again to go on", file=sys.stderr)
        return 130
    print(f"{args.episodes} episodes, {steps} steps in {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
