"""Learning curves of PPO and SAC: reached share and RMSE over steps, mean and spread of the training seeds.

    python -m agents.train_sb3 --env SealGym/Flat-v0 --control tip --seed 0 --out out/rl/flat_tip_0  # ...
    python -m experiments.learning_curves --runs out/rl --out experiments/results

Reads every run's folder below ``--runs``, plays random actions, the zero action, the expert and, if given,
behaviour-cloned policies on the same validation seeds, and writes ``learning_curves.json``, ``.csv``, ``.md``
and ``.png``. Without ``--runs`` the picture is drawn again from the JSON.
"""

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

import agents
import seal_gym
from agents.enjoy import find_policy
from agents.episodes import FIRST_VALIDATION_SEED
from agents.rollouts import play
from agents.train_sb3 import summary
from experiments import results
from seal_gym.core.errors import ConfigError, SealGymError, require
from seal_gym.envs.sb3 import make_sb3_vec

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

NAME = "learning_curves"
GOAL_REACHED_PCT, GOAL_RMSE_MM = 90.0, 1.0
_COLOURS = {"tip": "#d1382c", "rmp": "#1f5fa8"}
_CONTROLS = {"tip": "direct control (tip acceleration)", "rmp": "RMP (f and metric)"}
_LEVELS = {"random": ":", "zero": "-.", "rmp_expert": "--"}
_LEVEL_COLOUR = "#6d7278"
_MARKERS = {"tip": "o", "rmp": "s"}


class Constant:
    """Zero or random actions, with SB3's ``predict``."""

    def __init__(self, control: str, size: int, rng: np.random.Generator | None) -> None:
        self.control, self._size, self._rng = control, size, rng

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Actions for N observations."""
        del episode_start, deterministic
        shape = (len(observation), self._size)
        action = np.zeros(shape) if self._rng is None else self._rng.uniform(-1.0, 1.0, shape)
        return action.astype(np.float32), state


def read_runs(folder: Path) -> list[dict[str, Any]]:
    """The runs in a folder.

    Args:
        folder: With a folder for each run of ``agents.train_sb3``.

    Returns:
        One a run: its description and its evaluations.

    Raises:
        ConfigError: If there is none, or one is broken.
    """
    runs = []
    for file in sorted(folder.glob("*/run.json")):
        evaluations = file.with_name("evaluations.jsonl")
        try:
            about = json.loads(file.read_text(encoding="utf-8"))
            rows = [json.loads(line) for line in evaluations.read_text(encoding="utf-8").splitlines()]
            cfg = about["training"]
            runs.append(
                {
                    "env": cfg["env"],
                    "algo": cfg["net"]["algo"],
                    "control": cfg["net"]["control"],
                    "perception": cfg["perception"],
                    "training_seed": cfg["seed"],
                    "steps": cfg["steps"],
                    "init": cfg["init"],
                    "command": about["command"],
                    "stack": about["stack"],
                    "evaluations": rows,
                }
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{file.parent} holds no whole run ({error!r}): train it again") from error
    require(bool(runs), f"no runs in {folder}: make some with python -m agents.train_sb3 --out {folder}/NAME")
    return runs


def steps_to_goal(evaluations: list[dict[str, Any]]) -> int | None:
    """The first evaluation that meets the goal.

    Args:
        evaluations: Of one run, in order.

    Returns:
        Its steps; None if none does.
    """
    return next((row["step"] for row in evaluations if meets(row)), None)


def meets(row: dict[str, Any]) -> bool:
    """Whether an evaluation meets the goal: 90 % reached at 1 mm.

    Args:
        row: Of the run.

    Returns:
        Whether it does.
    """
    rmse = row["rmse_mm"]
    return bool(row["reached_pct"] >= GOAL_REACHED_PCT and rmse is not None and rmse <= GOAL_RMSE_MM)


def levels(env_id: str, episodes: int, perception: str, cloned: Iterable[Path] = ()) -> list[dict[str, Any]]:
    """What policies without reinforcement learning reach.

    Args:
        env_id: Of the environment.
        episodes: From the first validation seed on.
        perception: As the runs'.
        cloned: Weights of behaviour-cloned policies.

    Returns:
        One row a policy, as an evaluation's.
    """
    rows = []
    for control in _CONTROLS:
        venv = make_sb3_vec(env_id, episodes, control=control, perception=perception)
        size = (venv.action_space.shape or (0,))[0]
        policies: dict[str, Any] = {
            "random": Constant(control, size, np.random.default_rng(0)),
            "zero": Constant(control, size, None),
        }
        if agents.control_of("rmp_expert") == control:
            policies["rmp_expert"] = agents.load_policy("rmp_expert")
        for path in cloned:
            policy = find_policy(str(path))
            if policy.control == control:
                policies[f"bc_{path.stem}"] = policy
        for name, policy in policies.items():
            rows.append(
                {"policy": name, "env": env_id, "control": control, "perception": perception}
                | summary(play(policy, venv, FIRST_VALIDATION_SEED))
            )
        venv.close()
    return rows


def table_rows(runs: list[dict[str, Any]], level_rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row a run and one a level.

    Args:
        runs: From ``read_runs``.
        level_rows: From ``levels``.

    Returns:
        Rows: the last evaluation, and the steps to the goal.
    """
    names = (
        "episodes",
        "reached_pct",
        "collision_pct",
        "timeout_pct",
        "rmse_mm",
        "coverage_pct",
        "time_s",
        "return",
    )
    rows = []
    for run in runs:
        last = run["evaluations"][-1]
        rows.append(
            {
                "policy": run["algo"] if run["init"] is None else f"{run['algo']} from BC",
                **{k: run[k] for k in ("env", "control", "perception", "training_seed")},
                "steps": last["step"],
                "steps_to_goal": steps_to_goal(run["evaluations"]),
                **{k: last[k] for k in names},
            }
        )
    for level in level_rows:
        rows.append(
            {
                **{k: level[k] for k in ("policy", "env", "control", "perception")},
                "training_seed": None,
                "steps": 0,
                "steps_to_goal": None,
                **{k: level[k] for k in names},
            }
        )
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table for people.

    Args:
        rows: From ``table_rows``.

    Returns:
        Markdown.
    """
    head = [
        "policy",
        "environment",
        "control",
        "seed",
        "steps",
        "steps to goal",
        "reached %",
        "collision %",
        "timeout %",
    ]
    head += ["RMSE mm", "time s", "return"]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for row in rows:
        goal = "-" if row["steps_to_goal"] is None else f"{row['steps_to_goal']:,}"
        cells = [row["policy"], row["env"].removeprefix("SealGym/"), row["control"]]
        cells += ["-" if row["training_seed"] is None else str(row["training_seed"])]
        cells += [f"{row['steps']:,}" if row["steps"] else "-", goal]
        cells += [f"{row[k]:.0f}" for k in ("reached_pct", "collision_pct", "timeout_pct")]
        cells += ["-" if row["rmse_mm"] is None else f"{row['rmse_mm']:.4f}"]
        cells += ["-" if row["time_s"] is None else f"{row['time_s']:.1f}", f"{row['return']:.0f}"]
        lines.append("| " + " | ".join(cells) + " |")
    episodes = rows[0]["episodes"]
    lines += [
        "",
        f"Each figure from {episodes} validation episodes (seeds {FIRST_VALIDATION_SEED:,} on). Goal: at "
        "least "
        f"{GOAL_REACHED_PCT:.0f} % reached at an RMSE of at most {GOAL_RMSE_MM:.0f} mm; RMSE and time over "
        "the episodes that reached; the last evaluation of each run.",
    ]
    return "\n".join(lines)


def curves(runs: list[dict[str, Any]], name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """An evaluation's figure over steps, of runs that differ in their seed.

    Args:
        runs: From ``read_runs``.
        name: Of the figure.

    Returns:
        Steps that all of them were evaluated at, shape (k,), and the values, shape (len(runs), k); NaN where
        there is none: no episode reached the end.
    """
    tables = [{row["step"]: row[name] for row in run["evaluations"]} for run in runs]
    steps = sorted(set.intersection(*(set(table) for table in tables)))
    values = [[np.nan if table[step] is None else table[step] for step in steps] for table in tables]
    return np.array(steps, dtype=np.float64), np.array(values, dtype=np.float64)


def _draw_group(axes: Any, runs: list[dict[str, Any]], name: str, label: str) -> None:
    """Middle and range of the seeds; the mean of an RMSE is that of its logarithm, as the axis shows it."""
    steps, values = curves(runs, name)
    some = np.isfinite(values).any(axis=0)
    steps, values = steps[some] / 1e6, values[:, some]
    if not len(steps):
        return
    middle = np.exp(np.nanmean(np.log(values), axis=0)) if name == "rmse_mm" else np.nanmean(values, axis=0)
    control, ppo = runs[0]["control"], runs[0]["algo"] == "ppo"
    colour = _COLOURS[control]
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    axes.fill_between(steps, low, high, color=colour, alpha=0.18, lw=0)
    axes.plot(
        steps,
        middle,
        color=colour,
        ls="-" if ppo else "--",
        marker=_MARKERS[control],
        ms=4,
        lw=1.8,
        label=label,
    )


def draw(path: Path, runs: list[dict[str, Any]], rows: list[dict[str, Any]]) -> None:
    """Draws the curves: a column for each environment, reached share above, RMSE below.

    Args:
        path: The PNG file.
        runs: From ``read_runs``.
        rows: From ``table_rows``; those without a training seed are drawn as levels.
    """
    level_rows = [row for row in rows if row["training_seed"] is None]
    present = {run["env"] for run in runs}
    envs = [env for env in seal_gym.ENV_IDS if env in present]
    figure, grid = plt.subplots(
        2, len(envs), figsize=(6.2 * len(envs), 7.4), sharex="col", squeeze=False, constrained_layout=True
    )
    for column, env in enumerate(envs):
        reached, rmse = grid[:, column]
        here = [run for run in runs if run["env"] == env]
        groups = dict.fromkeys((run["algo"], run["control"], run["init"] is None) for run in here)
        for algo, control, scratch in groups:
            group = [
                r for r in here if (r["algo"], r["control"], r["init"] is None) == (algo, control, scratch)
            ]
            seeds = f"{len(group)} seed{'s' if len(group) > 1 else ''}"
            label = f"{algo.upper()}{'' if scratch else ' from BC'}, {_CONTROLS[control]}, {seeds}"
            _draw_group(reached, group, "reached_pct", label)
            _draw_group(rmse, group, "rmse_mm", label)
        _draw_levels(reached, rmse, [row for row in level_rows if row["env"] == env])
        reached.axhline(GOAL_REACHED_PCT, color="#2a9d54", lw=1.0)
        rmse.axhline(GOAL_RMSE_MM, color="#2a9d54", lw=1.0)
        reached.set(title=env, ylabel="episodes that reached the end [%]", ylim=(-3, 103))
        rmse.set(xlabel="steps of experience [millions]", ylabel="RMSE of those that reached [mm]")
        rmse.set_yscale("log")
        rmse.set_ylim(None, 10.0)
        for axes in (reached, rmse):
            axes.grid(color="#dddddd", lw=0.6)
        if column == 0:
            reached.legend(loc="center right", fontsize=8)
            for axes, goal in ((reached, GOAL_REACHED_PCT), (rmse, GOAL_RMSE_MM)):
                place = axes.get_yaxis_transform()
                axes.text(
                    0.99, goal, "goal", transform=place, color="#2a9d54", ha="right", va="bottom", fontsize=8
                )
    eyes = " and ".join(dict.fromkeys(run["perception"] for run in runs))
    figure.suptitle(
        f"Learning to seal, {eyes} features: mean and range of the training seeds, validation episodes"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_levels(reached: Any, rmse: Any, rows: list[dict[str, Any]]) -> None:
    """Levels of the policies that do not learn: one line each, grouped where they coincide."""
    shown: dict[float, list[str]] = {}
    for row in rows:
        name = f"{row['policy']} ({row['control']})"
        shown.setdefault(row["reached_pct"], []).append(name)
        if row["rmse_mm"] is not None:
            style = _LEVELS.get(row["policy"], "--")
            rmse.axhline(row["rmse_mm"], color=_LEVEL_COLOUR, ls=style, lw=1.1)
            rmse.text(
                0.01,
                row["rmse_mm"],
                f"{name} {row['rmse_mm']:.4f} mm",
                transform=rmse.get_yaxis_transform(),
                color=_LEVEL_COLOUR,
                fontsize=8,
                va="bottom",
            )
    for level, names in shown.items():
        reached.axhline(level, color=_LEVEL_COLOUR, ls="--", lw=1.1)
        reached.text(
            0.99,
            level + (1.0 if level < 50 else -1.5),
            ", ".join(names),
            transform=reached.get_yaxis_transform(),
            color=_LEVEL_COLOUR,
            fontsize=8,
            ha="right",
            va="bottom" if level < 50 else "top",
        )


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.learning_curves", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--runs", type=Path, help="folder with the runs' folders (default: draw the JSON again)"
    )
    parser.add_argument(
        "--bc",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="cloned policy to compare; may be repeated",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/learning_curves"), help="(default: %(default)s)"
    )
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Gathers and draws.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if the picture was drawn.
    """
    options = parse(arguments)
    try:
        if options.runs is None:
            file = options.out / f"{NAME}.json"
            require(file.is_file(), f"{file} not found: give the runs with --runs")
            document = json.loads(file.read_text(encoding="utf-8"))
            draw(options.out / f"{NAME}.png", document["trials"], document["rows"])
            return 0
        runs = read_runs(options.runs)
        episodes = runs[0]["evaluations"][0]["episodes"]
        seen = dict.fromkeys((run["env"], run["perception"]) for run in runs)
        level_rows = [row for env, eye in seen for row in levels(env, episodes, eye, options.bc)]
        options.out.mkdir(parents=True, exist_ok=True)
        rows = table_rows(runs, level_rows)
        text = markdown(rows)
        renderer = "raycast" if any(run["perception"] == "vision" for run in runs) else "none"
        results.write(options.out, NAME, rows, runs, renderer=renderer, regime="static", text=text)
        draw(options.out / f"{NAME}.png", runs, rows)
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    print(text)
    print(f"\nwritten to {options.out}/")
    return 0


if __name__ == "__main__":
    sys.exit(main())
