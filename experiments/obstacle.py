"""Add a leaf, retrain nothing: a fist reaches into the gun's way.

    python -m experiments.obstacle --trials 25 --seed 500000 --jobs 2 --out out/obstacle

``MovingObstacle`` in the way of the neural RMP, alone and with an obstacle leaf added at run time, and of
direct control, alone and behind filters that know what the leaf knows. Writes obstacle.json, .csv, .md and a
picture for each part. Trials are logged as they end: the same command goes on where it was stopped.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib as mpl
import mujoco
import numpy as np

import agents
from agents.filters import FILTERS, Filtered
from experiments import command, results, trials
from experiments.trials import Row, Trial
from seal_gym.core.errors import ConfigError
from seal_gym.envs.config import PERCEPTIONS
from seal_gym.envs.core import SealCore
from seal_gym.envs.leaves import ObstacleLeaf
from seal_gym.sim.scene import GUN_PREFIX, OBSTACLE
from seal_gym.workpieces import catalogue

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

NAME = "obstacle"
NONE, LEAF = "none", "leaf"
AIDS = (NONE, LEAF, *FILTERS)
_EVERY = 3  # frames between samples of the traces
_FAR_M = 0.5  # clearances beyond this are not measured
_MOVED_M = 1e-3  # a fist that far from where it waited is in the way


class Method(NamedTuple):
    """A row of the table.

    Attributes:
        policy: Name of the policy.
        aid: What keeps it off the obstacle, one of ``AIDS``.
        label: For people.
        colour: In pictures.
    """

    policy: str
    aid: str
    label: str
    colour: str


METHODS = (
    Method("neural_rmp", NONE, "neural RMP", "#9dbfe3"),
    Method("neural_rmp", LEAF, "neural RMP + leaf", "#1f5fa8"),
    Method("neural_control", NONE, "direct control", "#f0a8a2"),
    Method("neural_control", "brake", "direct control + brake", "#e8883a"),
    Method("neural_control", "cbf", "direct control + CBF", "#8e5bb5"),
    Method("neural_control", "brake_cbf", "direct control + brake, CBF", "#d1382c"),
    Method("rmp_expert", LEAF, "expert + leaf", "#6d7278"),
)


@dataclass(frozen=True, kw_only=True)
class Aided(Trial):
    """A trial with something that keeps the gun off the obstacle.

    Attributes:
        aid: One of ``AIDS``.
    """

    aid: str = NONE

    def spec(self) -> dict[str, Any]:
        """Enough to rebuild the run: ``trials.rebuild`` makes the environment, ``aided`` adds ``aid``.

        Returns:
            Ready for JSON.
        """
        return {**super().spec(), "aid": self.aid}


def aided(policy: agents.Policy, core: SealCore, aid: str) -> agents.Policy:
    """Adds a leaf to the cell, or puts a filter behind the policy.

    Args:
        policy: Any; stays as it is.
        core: Of the environment it acts in.
        aid: One of ``AIDS``.

    Returns:
        The policy to ask for actions.

    Raises:
        ConfigError: If there is no such aid.
    """
    if aid not in AIDS:
        raise ConfigError(f"aid = {aid!r}: must be one of {list(AIDS)}")
    if aid == LEAF:
        core.add_leaf(ObstacleLeaf())
    return Filtered(policy, core, FILTERS[aid]()) if aid in FILTERS else policy


def clearance_m(core: SealCore) -> float:
    """Smallest distance between the gun and the obstacle, by MuJoCo's own geometry.

    Args:
        core: With one simulation.

    Returns:
        At most ``_FAR_M``, negative inside [m].
    """
    model, data = core.scene.model, core.arm.data(0)
    gun = [g for g in range(model.ngeom) if model.geom(g).name.startswith(GUN_PREFIX + "col_")]
    ball = model.geom(OBSTACLE).id
    return min(float(mujoco.mj_geomDistance(model, data, g, ball, _FAR_M, None)) for g in gun)


def run(trial: Trial) -> Row:
    """Runs one trial.

    Args:
        trial: An ``Aided``.

    Returns:
        As ``trials.run`` has it, with ``aid``; ``clearance_mm``, the smallest; ``detour_mm``, the largest
        distance from the desired path while the obstacle was out; and ``trace``, samples of time [s],
        clearance [mm], progress along the seam [mm] and distance from the desired path [mm].
    """
    aid = trial.aid if isinstance(trial, Aided) else NONE
    env = gym.make(
        "SealGym/Seal-v0",
        workpiece=trials.workpiece(trial.workpiece),
        control=agents.control_of(trial.method),
        disable_env_checker=True,
        **trial.env,
    )
    core: SealCore = env.unwrapped.core  # type: ignore[attr-defined]
    policy = aided(agents.load_policy(trial.weights or trial.method, env), core, aid)
    observation, info = env.reset(seed=trial.seed)
    waits = info["obstacle"]["position_m"]
    state, start, done = None, np.array([True]), False
    trace, detour = [], 0.0
    while not done:
        action, state = policy.predict(observation, state=state, episode_start=start)
        observation, _, terminated, truncated, info = env.step(action)
        start, done = np.array([False]), terminated or truncated
        if np.linalg.norm(info["obstacle"]["position_m"] - waits) > _MOVED_M:
            detour = max(detour, info["tip_error_mm"])
        if done or core.frames[0] % _EVERY == 0:
            sample = (core.seconds(0), 1e3 * clearance_m(core), 1e3 * core.progress.s[0])
            trace.append([round(float(v), 3) for v in (*sample, info["tip_error_mm"])])
    env.close()  # type: ignore[no-untyped-call]  # gymnasium 0.29 leaves it untyped
    return {
        "method": trial.method,
        "aid": aid,
        "workpiece": trial.part,
        "seed": trial.seed,
        "training_seed": trial.training_seed,
        **info["episode_metrics"],
        "clearance_mm": min(sample[1] for sample in trace),
        "detour_mm": round(detour, 4),
        "trace": trace,
        "env_spec": trial.spec(),
    }


def plan(options: argparse.Namespace) -> list[Trial]:
    """The trials.

    Args:
        options: The command line.

    Returns:
        In the table's order.
    """
    env = {
        "perception": options.perception,
        "renderer": "raycast",
        "disturbances": [{"name": "MovingObstacle", "severity": options.severity}],
    }
    return [
        Aided(method=m.policy, workpiece=part, seed=options.seed + k, env=env, aid=m.aid)
        for m in METHODS
        if not options.policy or m.policy in options.policy
        for part in options.workpiece or catalogue.NAMES
        for k in range(options.trials)
    ]


def method_of(row: Row) -> Method:
    """Which line of the table a trial belongs to.

    Args:
        row: Of ``run``.

    Returns:
        The method.
    """
    return next(m for m in METHODS if (m.policy, m.aid) == (row["method"], row["aid"]))


def summarise(rows: Sequence[Row]) -> list[Row]:
    """One row for each method and part.

    Args:
        rows: Of ``run``.

    Returns:
        As ``results.summarise`` has them, with ``policy``, ``aid``, and mean ``detour_mm`` and
        ``clearance_mm`` of all trials with their intervals.
    """
    table = results.summarise([{**row, "method": method_of(row).label} for row in rows])
    for line in table:
        cell = [
            r for r in rows if (method_of(r).label, r["workpiece"]) == (line["method"], line["workpiece"])
        ]
        line["policy"], line["aid"] = cell[0]["method"], cell[0]["aid"]
        for key in ("detour_mm", "clearance_mm"):
            values = [r[key] for r in cell]
            line[key], line[f"{key}_ci"] = float(np.mean(values)), results.bootstrap(values)
    return table


def markdown(table: Sequence[Row]) -> str:
    """The table for people.

    Args:
        table: Of ``summarise``.

    Returns:
        Markdown.
    """
    head = ["method", "workpiece", "trials", "collision %", "reached %", "other %"]
    head += ["RMSE mm", "detour mm", "clearance mm", "time s"]
    digits = {"collision_pct": 0, "reached_pct": 0, "timeout_pct": 0}
    digits |= {"rmse_mm": 3, "detour_mm": 2, "clearance_mm": 1, "time_s": 1}
    body = [
        [r["method"], r["workpiece"], str(r["trials"])]
        + [results.with_interval(r, key, n) for key, n in digits.items()]
        for r in table
    ]
    note = (
        "A fist of 45 mm radius reaches over the wall into the gun's way, stays and withdraws. "
        "95 % intervals. RMSE and time: of trials that reached. "
        "Detour: largest distance from the desired path while the fist is out. "
        "Clearance: smallest distance of the gun from the fist. Other: lost, or out of time."
    )
    return f"{note}\n\n{results.grid(head, body)}"


def draw(out: Path, rows: Sequence[Row]) -> list[Path]:
    """Draws the first trial of each method, one picture for each part.

    Args:
        out: The folder.
        rows: Of ``run``, with their traces.

    Returns:
        The files.
    """
    files = []
    for part in dict.fromkeys(row["workpiece"] for row in rows):
        first: dict[Method, Row] = {}
        for row in rows:
            if row["workpiece"] == part:
                first.setdefault(method_of(row), row)
        files.append(out / f"{NAME}_{part}.png")
        _draw_part(files[-1], part, first)
    return files


def _draw_part(file: Path, part: str, first: Mapping[Method, Row]) -> None:
    titles = ("gun to fist [mm]", "way along the seam [mm]", "distance from the path [mm]")
    figure, axes = plt.subplots(3, 1, figsize=(9, 9.5), sharex=True, layout="constrained")
    for method, row in first.items():
        t, *series = np.array(row["trace"]).T
        end = {"collision": "X", "reached": "o"}.get(row["outcome"], "s")
        for ax, values in zip(axes, series, strict=True):
            ax.plot(t, values, color=method.colour, lw=1.6, label=f"{method.label}: {row['outcome']}")
            ax.plot(t[-1], values[-1], end, color=method.colour, ms=8, mec="black", mew=0.6)
    for ax, title in zip(axes, titles, strict=True):
        ax.set_ylabel(title)
        ax.grid(alpha=0.3)
    axes[0].set_ylim(-5, 150)
    axes[0].axhline(0.0, color="black", lw=1.0)
    axes[2].set_yscale("log")
    axes[2].set_ylim(1e-2, 30)
    axes[2].set_xlabel("time [s]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    seed = next(iter(first.values()))["seed"]
    figure.suptitle(f"A fist in the gun's way, {part} part, seed {seed} (X: collision, o: seam sealed)")
    figure.savefig(file, dpi=130)
    plt.close(figure)


def write(rows: Sequence[Row], options: argparse.Namespace) -> str:
    """Writes the files.

    Args:
        rows: Of ``run``.
        options: The command line.

    Returns:
        The table for people.
    """
    table = summarise(rows)
    pictures = draw(options.out, rows)
    shown = "\n".join(f"![{p.stem}]({p.name})" for p in pictures)
    environments, light = trials.shared([{k: v for k, v in r.items() if k != "trace"} for r in rows])
    results.write(
        options.out,
        NAME,
        table,
        light,
        renderer="raycast" if options.perception == "vision" else "none",
        regime="static",
        text=f"{markdown(table)}\n\n{shown}",
        more={"disturbances": json.loads(json.dumps(rows[0]["env_spec"]["kwargs"]["disturbances"]))}
        | {"environments": environments},
    )
    return markdown(table)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.obstacle", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--policy",
        action="append",
        choices=tuple(dict.fromkeys(m.policy for m in METHODS)),
        help="may be repeated (default: all)",
    )
    command.add_trials(parser, NAME, "method and part", "time the fist stays")
    parser.add_argument("--perception", default=PERCEPTIONS[0], choices=PERCEPTIONS)
    return command.checked_trials(parser, arguments)


def main(arguments: list[str] | None = None) -> int:
    """Makes the table.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    return command.run_trials(NAME, plan(options), run, write, options)


if __name__ == "__main__":
    sys.exit(main())
