"""Chooses the settings of the adaptive baseline on validation seeds.

    python -m agents.tune_adaptive --trials 20 --seed 500000 --out out/adaptive
    python -m agents.tune_adaptive --severity 1 --out out/adaptive_moving

Starting from ``AdaptiveCfg()`` each parameter in turn goes through its choices, the others staying at the
best so far; best is what reached most often over the three parts, then what has the smallest RMSE (in steps
of 0.005 mm), then the first. Killed and started again with the same command it goes on. The parts stand
still, or move with --severity (``MovingWorkpiece``). With --plain one line and no estimate of the part's
motion, as published. Look-aheads below 3 mm are left out: the sealant that wells up before the mouth would
cover the line. With perception="oracle", as the policy looks at no image.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.adaptive import Adaptive, AdaptiveCfg
from agents.episodes import FIRST_VALIDATION_SEED
from seal_gym.core.errors import SealGymError, require
from seal_gym.envs.sb3 import SealSb3VecEnv
from seal_gym.workpieces.catalogue import NAMES
from seal_gym.wrappers.moving_workpiece import MovingWorkpieceCfg

CHOICES: dict[str, tuple[float, ...]] = {
    "look_ahead_m": (0.003, 0.0045, 0.008, 0.015),
    "window": (12, 24, 40),
    "order": (1, 2, 3),
    "omega_n": (8.0, 12.0),
    "second_line_m": (1e-3, 1.5e-3, 3e-3),
    "motion": (1, 2),
    "accel_m_s2": (3e-3, 1e-2),
}
_OF_MOTION = ("second_line_m", "motion", "accel_m_s2")  # ``AdaptiveCfg.plain()`` has none of it
_SAME_MM = 0.005
_FIRST_TABLE_SEED = 1_000_000

Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class TuneCfg:
    """What is tuned, and on what.

    Attributes:
        trials: Of each part and setting.
        seed: Of the first trial.
        severity: Of ``MovingWorkpiece``; 0: the parts stand still.
        plain: The variant as published, or the one that estimates the part's motion.
    """

    trials: int = 20
    seed: int = FIRST_VALIDATION_SEED
    severity: float = 0.0
    plain: bool = False

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(self.trials >= 1, f"--trials {self.trials}: must be at least 1")
        require(
            FIRST_VALIDATION_SEED <= self.seed <= _FIRST_TABLE_SEED - self.trials,
            f"--seed {self.seed}: tuning is for {FIRST_VALIDATION_SEED}..{_FIRST_TABLE_SEED - 1}",
        )
        MovingWorkpieceCfg(severity=self.severity)  # it knows its range

    @property
    def base(self) -> AdaptiveCfg:
        """The settings to start from."""
        return AdaptiveCfg.plain() if self.plain else AdaptiveCfg()

    @property
    def choices(self) -> dict[str, tuple[float, ...]]:
        """The parameters to choose, and among what."""
        return {n: v for n, v in CHOICES.items() if not (self.plain and n in _OF_MOTION)}


def configure(settings: dict[str, float], base: AdaptiveCfg | None = None) -> AdaptiveCfg:
    """The configuration of some settings.

    Args:
        settings: Values by the names in ``CHOICES``.
        base: What the other settings are taken from; ``AdaptiveCfg()`` by default.

    Returns:
        ``base`` with these.
    """
    others = {name: value for name, value in settings.items() if name != "look_ahead_m"}
    cfg = replace(base or AdaptiveCfg(), **others)  # type: ignore[arg-type]  # whole numbers are ints in CHOICES
    look_ahead = settings.get("look_ahead_m", cfg.depth.look_ahead_m)
    return replace(cfg, depth=replace(cfg.depth, look_ahead_m=look_ahead))


def episodes(
    workpiece: str,
    trials: int,
    seed: int,
    cfg: AdaptiveCfg | None = None,
    severity: float = 0.0,
    perception: str = "oracle",
) -> list[dict[str, Any]]:
    """Metrics of the baseline's episodes.

    Args:
        workpiece: Name of the part.
        trials: How many, all at once.
        seed: Of the first; the others follow.
        cfg: The baseline's settings.
        severity: Of ``MovingWorkpiece``; 0: the parts stand still.
        perception: Of the environment; the baseline does not use it.

    Returns:
        ``episode_metrics`` of each, in order.
    """
    venv = SealSb3VecEnv(
        trials,
        workpiece=workpiece,
        control=Adaptive.control,
        perception=perception,
        disturbances=[MovingWorkpieceCfg(severity=severity)],
    )
    policy = Adaptive.of(venv, cfg)
    venv.seed(seed)
    observation: Any = venv.reset()
    state, start = None, np.ones(trials, np.bool_)
    ended: dict[int, dict[str, Any]] = {}
    while len(ended) < trials:
        action, state = policy.predict(observation, state, start)
        observation, _, start, infos = venv.step(action)
        for i in map(int, np.flatnonzero(start)):
            ended.setdefault(i, infos[i]["episode_metrics"])
    venv.close()
    return [ended[i] for i in range(trials)]


def summary(metrics: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counts of the outcomes, and mean RMSE and time of the trials that reached.

    Args:
        metrics: ``episode_metrics`` of trials.

    Returns:
        Ready for JSON; None where no trial reached.
    """
    reached = [m for m in metrics if m["reached"]]
    return {
        "trials": len(metrics),
        "reached": len(reached),
        "collision": sum(m["collision"] for m in metrics),
        "timeout": sum(m["timeout"] for m in metrics),
        "rmse_mm": float(np.mean([m["rmse_mm"] for m in reached])) if reached else None,
        "time_s": float(np.mean([m["time_s"] for m in reached])) if reached else None,
    }


def _evaluate(settings: dict[str, float], cfg: TuneCfg, log: Path) -> Row:
    """All parts with some settings, from the log where they are in it."""
    asked = {"settings": settings, **asdict(cfg)}
    for line in log.read_text(encoding="utf-8").splitlines() if log.exists() else ():
        row: Row = json.loads(line)
        if {k: row.get(k) for k in asked} == asked:
            return row
    found = configure(settings, cfg.base)
    parts = {name: summary(episodes(name, cfg.trials, cfg.seed, found, cfg.severity)) for name in NAMES}
    row = {**asked, "parts": parts}
    with log.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")
    return row


def _score(row: Row) -> tuple[int, float]:
    """Trials that reached, and the mean of the parts' RMSE in steps too small to matter."""
    parts = row["parts"].values()
    rmse = [p["rmse_mm"] for p in parts if p["rmse_mm"] is not None]
    return sum(p["reached"] for p in parts), -round(float(np.mean(rmse)) / _SAME_MM) if rmse else -np.inf


def tune(cfg: TuneCfg, log: Path) -> Iterator[Row]:
    """Runs the search.

    Args:
        cfg: What is tuned, and on what.
        log: A file of JSON lines, one for each setting.

    Yields:
        A row for each setting as it ends; the last one is the best again.
    """
    settings = {name: _value(cfg.base, name) for name in cfg.choices}
    best = _evaluate(settings, cfg, log)
    yield best
    for name, values in cfg.choices.items():
        for value in values:
            if value == settings[name]:
                continue
            row = _evaluate({**settings, name: value}, cfg, log)
            yield row
            if _score(row) > _score(best):
                best = row
        settings = best["settings"]
    yield best


def _value(cfg: AdaptiveCfg, name: str) -> float:
    return float(cfg.depth.look_ahead_m) if name == "look_ahead_m" else getattr(cfg, name)


def table(rows: Sequence[Row]) -> str:
    """The settings tried as a Markdown table.

    Args:
        rows: From ``tune``.

    Returns:
        One line a setting: reached of trials and RMSE in mm of each part.
    """
    names = list(rows[0]["settings"])
    head = [*names, *NAMES]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for row in rows:
        cells = [f"{row['settings'][name]:g}" for name in names]
        for part in row["parts"].values():
            rmse = "-" if part["rmse_mm"] is None else f"{part['rmse_mm']:.3f}"
            cells.append(f"{part['reached']}/{part['trials']}, {rmse}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> None:
    """The command line.

    Args:
        argv: Arguments; ``sys.argv`` by default.
    """
    assert __doc__
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=20, help="of each part and setting")
    parser.add_argument("--seed", type=int, default=FIRST_VALIDATION_SEED, help="of the first trial")
    parser.add_argument("--severity", type=float, default=0.0, help="of MovingWorkpiece; 0: parts at rest")
    parser.add_argument("--plain", action="store_true", help="tune the variant as published")
    parser.add_argument("--out", type=Path, required=True, help="folder for tune_adaptive.jsonl and .md")
    args = parser.parse_args(argv)
    try:
        cfg = TuneCfg(trials=args.trials, seed=args.seed, severity=args.severity, plain=args.plain)
    except SealGymError as error:
        sys.exit(str(error))
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for row in tune(cfg, args.out / "tune_adaptive.jsonl"):
        rows.append(row)
        print(json.dumps(row), flush=True)
    text = table(rows[:-1]) + f"\nBest: {json.dumps(rows[-1]['settings'])}\n"
    (args.out / "tune_adaptive.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
