"""The bead that the gun lays at constant and at regulated pressure, and what a smoothing pass makes of it.

    python -m experiments.bead_quality --trials 20 --seed 500000 --jobs 2 --out experiments/results

Each run draws a cartridge of its own: yield stress and consistency vary, and no policy is told. Writes
bead_quality.json, .csv, .md and two figures. Trials are logged as they end: the same command goes on where it
was stopped.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import numpy as np

import agents
from agents.rollouts import play_once
from experiments import command, results, trials
from experiments.trials import Row, Trial
from seal_gym.core.frames import Array
from seal_gym.envs.core import SealCore
from seal_gym.envs.smoothing import inverse, smoothing_pass
from seal_gym.workpieces import catalogue
from seal_gym.wrappers import dynamic_regime

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

NAME = "bead_quality"
PRESSURES = ("constant", "regulated")
POLICIES = ("rmp_expert", "neural_rmp")
_COLOURS = {"constant": "#c0392b", "regulated": "#1f5fa8"}
_EVERY = 4  # rows of the strip, 2 mm, in the rows of the table
_MEANS = (
    "bead_section_pct",
    "bead_rmse_pct",
    "corner_section_pct",
    "gaps_pct",
    "bead_width_mm",
    "contact_mm",
    "smoothed_contact_mm",
    "removed_pct",
)


@dataclass(frozen=True, kw_only=True)
class Pressed(Trial):
    """A trial with sealant.

    Attributes:
        pressure: Who presses the gun, one of ``PRESSURES``.
    """

    pressure: str = "regulated"

    def spec(self) -> dict[str, Any]:
        """Enough to rebuild the run: ``trials.rebuild`` makes the environment, ``load_policy`` the pressure.

        Returns:
            Ready for JSON.
        """
        return {**super().spec(), "pressure": self.pressure}


def seal(trial: Pressed) -> tuple[SealCore, dict[str, Any], Array]:
    """Seals once.

    Args:
        trial: What to run.

    Returns:
        The simulation after it, the episode's metrics, and ``T_part_tip`` of each frame, shape (n, 4, 4), m.
    """
    env = gym.make(
        "SealGym/Seal-v0",
        workpiece=trials.workpiece(trial.workpiece),
        control=agents.control_of(trial.method),
        disable_env_checker=True,
        **trial.env,
    )
    policy = agents.load_policy(trial.weights or trial.method, env, pressure=trial.pressure)
    core: SealCore = env.unwrapped.core  # type: ignore[attr-defined]  # gymnasium types the bare Env
    tips: list[Array] = []

    def watch(_: Any, __: Any) -> None:
        tips.append(inverse(core.arm.part_pose[0]) @ core.tip.pose[0])

    metrics = play_once(policy, env, trial.seed, watch)
    return core, metrics, np.array(tips)


def run(trial: Trial) -> Row:
    """Runs one trial, and the smoothing pass if it reached the end of a part that stands still.

    Args:
        trial: A ``Pressed``.

    Returns:
        As ``trials.run`` has it, with the bead's metrics, its ``share`` of the wanted section every 2 mm, and
        what the smoothing changed.
    """
    assert isinstance(trial, Pressed)
    core, metrics, tips = seal(trial)
    assert core.extrusion is not None
    bead = core.extrusion.bead
    profile = bead.profile(0)
    share = np.round(profile.section / profile.wanted, 3)[::_EVERY]
    del metrics["return"]  # depends on the reward's weights
    contact = float(1e3 * bead.contact(0).mean())
    row: Row = {
        "method": trial.method,
        "pressure": trial.pressure,
        "workpiece": trial.part,
        "training_seed": trial.training_seed,
        **{k: (None if isinstance(v, float) and np.isnan(v) else v) for k, v in metrics.items()},
        "contact_mm": contact,
        "smoothed_contact_mm": None,
        "smoothing_touched": None,
        "removed_pct": None,
        "share": share.tolist(),
        "env_spec": trial.spec(),
    }
    if metrics["reached"] and not core.cfg.disturbances:
        laid = bead.volume[0].sum()
        smoothed = smoothing_pass(core, 0, tips)
        row |= {
            "smoothed_contact_mm": float(1e3 * bead.contact(0).mean()),
            "smoothing_touched": smoothed.touched,
            "removed_pct": float(100.0 * smoothed.removed_m3 / laid),
        }
    return row


def plan(options: argparse.Namespace) -> list[Trial]:
    """The trials.

    Args:
        options: The command line.

    Returns:
        In the table's order.
    """
    env: dict[str, Any] = {"perception": "vision", "renderer": "raycast", "sealant": True}
    if options.moving:
        env["disturbances"] = dynamic_regime(options.severity)
    return [
        Pressed(method=policy, workpiece=part, seed=options.seed + k, env=env, pressure=pressure)
        for part in options.workpiece or catalogue.NAMES
        for pressure in PRESSURES
        for policy in options.policy or POLICIES
        for k in range(options.trials)
    ]


def summarise(rows: Sequence[Row]) -> list[Row]:
    """One row for each part, pressure and policy.

    Args:
        rows: Of ``run``.

    Returns:
        As ``results.summarise`` has them, with ``pressure`` and the means of the bead's metrics over the
        trials that reached; ``section_sd_pct`` is the spread of the mean section from run to run.
    """
    table: list[Row] = []
    for part in dict.fromkeys(row["workpiece"] for row in rows):
        for pressure in PRESSURES:
            mine = [r for r in rows if (r["workpiece"], r["pressure"]) == (part, pressure)]
            for line in results.summarise(mine):
                whole = [r for r in mine if r["method"] == line["method"] and r["reached"]]
                more: Row = {}
                for key in _MEANS:
                    values = [r[key] for r in whole if r.get(key) is not None]
                    more[key] = float(np.mean(values)) if values else None
                    more[f"{key.removesuffix('_pct')}_ci"] = results.bootstrap(values)
                sections = [r["bead_section_pct"] for r in whole]
                more["section_sd_pct"] = float(np.std(sections, ddof=1)) if len(sections) > 1 else None
                table.append({"pressure": pressure, **line, **more})
    return table


def _cell(row: Row, key: str, digits: int) -> str:
    return "-" if row[key] is None else results.with_interval(row, key, digits)


def markdown(table: Sequence[Row], regime: str) -> str:
    """The table for people.

    Args:
        table: Of ``summarise``.
        regime: ``"static"`` or ``"dynamic"``.

    Returns:
        Markdown.
    """
    columns = (
        ("reached %", "reached_pct", 0),
        ("RMSE mm", "rmse_mm", 3),
        ("section %", "bead_section_pct", 0),
        ("its error along the seam %", "bead_rmse_pct", 0),
        ("at corners %", "corner_section_pct", 0),
        ("gaps %", "gaps_pct", 1),
        ("contact mm", "contact_mm", 1),
        ("smoothed mm", "smoothed_contact_mm", 1),
    )
    head = ["workpiece", "pressure", "method", "trials", *(c[0] for c in columns), "section's sd %"]
    body = [
        [r["workpiece"], r["pressure"], r["method"], str(r["trials"])]
        + [_cell(r, key, n) for _, key, n in columns]
        + ["-" if r["section_sd_pct"] is None else f"{r['section_sd_pct']:.0f}"]
        for r in table
    ]
    note = (
        f"Beads laid by vision, {regime} parts, each run with another cartridge. Section: volume per length "
        "relative to the wanted bead, mean over the seam; its error: root mean square along the seam; at "
        "corners: its mean there; gaps: share of the seam with less than 30 % of it; contact: wet length on "
        "wall and on plate, before and after a smoothing pass. Trials that reached; 95 % intervals."
    )
    return f"{note}\n\n{results.grid(head, body)}"


def draw(file: Path, rows: Sequence[Row]) -> None:
    """Draws the section along each part: median and 10 to 90 % of the expert's runs.

    Args:
        file: Of the picture.
        rows: Of ``run``.
    """
    parts = list(dict.fromkeys(r["workpiece"] for r in rows))
    figure, axes = plt.subplots(
        len(parts), 1, figsize=(9, 2.6 * len(parts)), squeeze=False, layout="constrained"
    )
    method = rows[0]["method"]
    for ax, part in zip(axes[:, 0], parts, strict=True):
        for pressure in PRESSURES:
            mine = [
                r for r in rows if (r["workpiece"], r["pressure"], r["method"]) == (part, pressure, method)
            ]
            share = np.array([r["share"] for r in mine if r["reached"]])
            if not len(share):
                continue
            s = np.arange(share.shape[1]) * 0.5 * _EVERY
            low, middle, high = np.quantile(share, (0.1, 0.5, 0.9), axis=0)
            ax.fill_between(s, 100 * low, 100 * high, color=_COLOURS[pressure], alpha=0.22, lw=0)
            ax.plot(s, 100 * middle, color=_COLOURS[pressure], lw=1.6, label=f"{pressure} pressure")
        for first, last in 1e3 * catalogue.get(part).seam.corners if part in catalogue.NAMES else ():
            ax.axvspan(first, last, color="#999999", alpha=0.3, lw=0, label="corner")
        ax.axhline(100, color="black", lw=0.8, ls=":")
        ax.set(title=part, ylabel="section [% of wanted]", ylim=(0, 220), xlim=(0, None))
        ax.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("along the seam [mm]")
    handles, labels = axes[-1, 0].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=len(unique))
    figure.suptitle(f"Bead of {method} by vision: median and 10 to 90 % of runs with different cartridges")
    figure.savefig(file, dpi=130)
    plt.close(figure)


def draw_corner(file: Path, seed: int) -> None:
    """Draws one run's bead in the first corner of the rectangular part from above.

    Args:
        file: Of the picture.
        seed: Of the run, the same for both pressures.
    """
    env = {"perception": "vision", "renderer": "raycast", "sealant": True}
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.6), layout="constrained", sharex=True, sharey=True)

    def show(ax: Any, core: SealCore, title: str) -> Any:
        assert core.extrusion is not None
        bead = core.extrusion.bead
        strip, height = bead.strip, 1e3 * bead.height[0]
        base = 1e3 * strip.base + height[..., None] * strip.column[:, None]
        low, high = core.scene.workpiece.seam.corners[0]
        rows = (strip.arc > low - 20e-3) & (strip.arc < high + 20e-3)
        shown = np.ma.masked_less(height[rows], 0.05)
        mesh = ax.pcolormesh(
            base[rows, :, 0], base[rows, :, 1], shown, shading="gouraud", vmin=0, vmax=5, cmap="viridis"
        )
        foot = 1e3 * strip.base[rows, len(strip.across) // 2]
        ax.plot(foot[:, 0], foot[:, 1], color="black", lw=0.8)
        ax.set(title=title, aspect="equal", xlabel="x [mm]")
        ax.grid(alpha=0.3)
        return mesh

    for ax, pressure in zip(axes, PRESSURES, strict=False):
        trial = Pressed(method="rmp_expert", workpiece="rectangular", seed=seed, env=env, pressure=pressure)
        core, _, tips = seal(trial)
        show(ax, core, f"{pressure} pressure")
    smoothing_pass(core, 0, tips)
    mesh = show(axes[2], core, "regulated, smoothed")
    axes[0].set_ylabel("y [mm]")
    figure.colorbar(mesh, ax=axes, label="height of the bead [mm]", shrink=0.8)
    figure.suptitle(f"The bead in a corner of the rectangular part from above, seed {seed} (line: the seam)")
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
    regime = "dynamic" if options.moving else "static"
    table = summarise(rows)
    text = markdown(table, regime)
    draw(options.out / f"{NAME}.png", rows)
    figures = f"![{NAME}]({NAME}.png)"
    if not options.moving and any(r["workpiece"] == "rectangular" for r in rows):
        draw_corner(options.out / f"{NAME}_corner.png", options.seed)
        figures += f"\n\n![{NAME}_corner]({NAME}_corner.png)"
    environments, light = trials.shared(rows)
    results.write(
        options.out,
        NAME,
        table,
        light,
        renderer="raycast",
        regime=regime,
        text=f"{text}\n\n{figures}",
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
        prog="python -m experiments.bead_quality", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--policy", action="append", choices=POLICIES, help="may be repeated (default: all)")
    parser.add_argument("--moving", action="store_true", help="parts move, in the dynamic regime")
    command.add_trials(parser, NAME, "part, pressure and policy", "of the dynamic regime, with --moving")
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
