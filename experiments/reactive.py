"""What makes moving parts sealable: parts of the reactive control switched off, one at a time.

    python -m experiments.reactive --trials 20 --seed 500000 --jobs 2 --out experiments/results

The expert and the neural RMP in the dynamic regime at severity 1, with everything and without one part of it.
Writes reactive.json, .csv, .md and a figure. Trials are logged as they end: the same command goes on where it
was stopped.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib as mpl
import numpy as np
from matplotlib.lines import Line2D

import agents
from agents.expert import RmpExpert
from agents.rollouts import play_once
from experiments import command, results, trials
from experiments.trials import Row, Trial
from seal_gym.core.errors import ConfigError
from seal_gym.rmp import SealingCfg, TravelCfg
from seal_gym.vision.perception import PerceptionCfg
from seal_gym.workpieces import catalogue
from seal_gym.wrappers import dynamic_regime

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

NAME = "reactive"
POLICIES = ("rmp_expert", "neural_rmp")
_OFF = 1e-9  # gains have to be positive
_COLOURS = {"rmp_expert": "#6d7278", "neural_rmp": "#1f5fa8"}
_ALL = "everything"


class Variant(NamedTuple):
    """Reactive control with one part of it missing.

    Attributes:
        label: For people.
        env: Keyword arguments of the environment.
    """

    label: str
    env: dict[str, Any]


_TRACKER = PerceptionCfg()
_FULL_SPEED = SealingCfg(travel=TravelCfg(turn_rad_s=1e6))
VARIANTS = {
    _ALL: Variant("everything", {}),
    "follow": Variant(
        "the memory stays where it was seen",
        {"vision": replace(_TRACKER, follow_gain=_OFF, velocity_gain=_OFF)},
    ),
    "along": Variant(
        "motion along the seam is not read from bends", {"vision": replace(_TRACKER, along_gain=_OFF)}
    ),
    "feed_forward": Variant("the seam's motion is not fed forward", {"seam_rate_gain": 0.0}),
    "slow_turns": Variant("full speed in fast turns", {"sealing": _FULL_SPEED}),
}


@dataclass(frozen=True, kw_only=True)
class Ablated(Trial):
    """A trial with a part of the reactive control switched off.

    Attributes:
        without: One of ``VARIANTS``.
    """

    without: str = _ALL

    def spec(self) -> dict[str, Any]:
        """Enough to rebuild the run: ``trials.rebuild`` makes the environment, ``VARIANTS`` what is off.

        Returns:
            Ready for JSON.
        """
        return {**super().spec(), "without": self.without}


def run(trial: Trial) -> Row:
    """Runs one trial.

    Args:
        trial: An ``Ablated``.

    Returns:
        As ``trials.run`` has it, with ``without``.

    Raises:
        ConfigError: If there is no such variant.
    """
    without = trial.without if isinstance(trial, Ablated) else _ALL
    if without not in VARIANTS:
        raise ConfigError(f"without = {without!r}: must be one of {list(VARIANTS)}")
    changed = VARIANTS[without].env
    env = gym.make(
        "SealGym/Seal-v0",
        workpiece=trials.workpiece(trial.workpiece),
        control=agents.control_of(trial.method),
        disable_env_checker=True,
        **trial.env,
        **changed,
    )
    if trial.method == "rmp_expert":
        # Its own leaves slow down in turns too.
        policy: agents.Policy = RmpExpert(sealing=changed.get("sealing"))
    else:
        policy = agents.load_policy(trial.weights or trial.method, env)
    metrics = play_once(policy, env, trial.seed)
    env.close()  # type: ignore[no-untyped-call]  # gymnasium 0.29 leaves it untyped
    del metrics["return"]  # depends on the reward's weights
    return {
        "method": trial.method,
        "without": without,
        "workpiece": trial.part,
        "training_seed": trial.training_seed,
        **{k: (None if isinstance(v, float) and np.isnan(v) else v) for k, v in metrics.items()},
        "env_spec": trial.spec(),
    }


def plan(options: argparse.Namespace) -> list[Trial]:
    """The trials.

    Args:
        options: The command line.

    Returns:
        In the table's order.
    """
    regime = dynamic_regime(options.severity)
    env = {"perception": "vision", "renderer": "raycast", "disturbances": regime}
    return [
        Ablated(method=policy, workpiece=part, seed=options.seed + k, env=env, without=without)
        for part in options.workpiece or catalogue.NAMES
        for without in VARIANTS
        for policy in options.policy or POLICIES
        for k in range(options.trials)
    ]


def summarise(rows: Sequence[Row]) -> list[Row]:
    """One row for each part, variant and method.

    Args:
        rows: Of ``run``.

    Returns:
        As ``results.summarise`` has them, with ``without``.
    """
    table: list[Row] = []
    for part in dict.fromkeys(row["workpiece"] for row in rows):
        for without in dict.fromkeys(row["without"] for row in rows):
            mine = [r for r in rows if (r["workpiece"], r["without"]) == (part, without)]
            table += [{"without": without, **line} for line in results.summarise(mine)]
    return table


def markdown(table: Sequence[Row], severity: float) -> str:
    """The table for people.

    Args:
        table: Of ``summarise``.
        severity: Of the dynamic regime.

    Returns:
        Markdown.
    """
    head = ["workpiece", "reactive control", "method", "trials", "reached %", "RMSE mm"]
    body = [
        [r["workpiece"], VARIANTS[r["without"]].label, r["method"], str(r["trials"])]
        + [results.with_interval(r, key, n) for key, n in (("reached_pct", 0), ("rmse_mm", 3))]
        for r in table
    ]
    note = (
        f"Dynamic regime at severity {severity:g}. One part of the reactive control is switched off in each "
        "line but the first. 95 % intervals; RMSE: of trials that reached."
    )
    return f"{note}\n\n{results.grid(head, body)}"


def draw(file: Path, table: Sequence[Row]) -> None:
    """Draws the share that reached and the RMSE of each variant.

    Args:
        file: Of the picture.
        table: Of ``summarise``.
    """
    parts = list(dict.fromkeys(r["workpiece"] for r in table))
    names = [n for n in VARIANTS if any(r["without"] == n for r in table)]
    policies = list(dict.fromkeys(r["method"] for r in table))
    figure, axes = plt.subplots(
        2, len(parts), figsize=(4.2 * len(parts) + 2.6, 5.6), sharey=True, squeeze=False, layout="constrained"
    )
    for column, part in enumerate(parts):
        for ax, key, label in zip(
            axes[:, column], ("reached_pct", "rmse_mm"), ("reached [%]", "RMSE [mm]"), strict=True
        ):
            for offset, policy in zip(np.linspace(-0.16, 0.16, len(policies)), policies, strict=True):
                rows = [r for r in table if (r["workpiece"], r["method"]) == (part, policy)]
                for r in rows:
                    y = names.index(r["without"]) + offset
                    ends = r["reached_ci"] if key == "reached_pct" else r["rmse_mm_ci"]
                    if r[key] is None:
                        ax.text(0.4, y, "none reached", transform=ax.get_yaxis_transform(), fontsize=8)
                        continue
                    if ends:
                        ax.plot(ends, (y, y), color=_COLOURS[policy], lw=1.6)
                    ax.plot(r[key], y, "o", color=_COLOURS[policy], ms=6)
            ax.set_xlabel(label)
            ax.grid(axis="x", alpha=0.3)
        axes[0, column].set_title(part)
        axes[0, column].set_xlim(-4, 104)
        axes[1, column].set_xlim(left=0.0)
    for ax in axes[:, 0]:
        ax.set_yticks(range(len(names)), [VARIANTS[n].label for n in names], fontsize=9)
    axes[0, 0].invert_yaxis()  # shared by all
    handles = [Line2D([], [], color=_COLOURS[p], marker="o", label=p) for p in policies]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(policies))
    figure.suptitle("Moving parts: reactive control with one part of it switched off")
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
    text = markdown(table, options.severity)
    draw(options.out / f"{NAME}.png", table)
    environments, light = trials.shared(rows)
    results.write(
        options.out,
        NAME,
        table,
        light,
        renderer="raycast",
        regime="dynamic",
        text=f"{text}\n\n![{NAME}]({NAME}.png)",
        more={"environments": environments},
    )
    return text


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.reactive", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--policy", action="append", choices=POLICIES, help="may be repeated (default: all)")
    command.add_trials(parser, NAME, "part, variant and policy", "of the dynamic regime")
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
