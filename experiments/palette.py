"""Ties on random palettes, pressed home by the scripted policy, with and without a camera.

    python -m experiments.palette --trials 100 --seed 500000 --jobs 2 --out experiments/results

With ``--perception oracle`` the policy is told where the targets are, with ``hopfield`` and ``threshold`` it
gets what that observer made of one noisy RGB-D picture; ``--perception MODULE:FUNCTION`` runs another one.
Completed: all ties home and nothing else touched. Writes palette.json, .csv, .md, figures of the first
palette by the first observer named and, where OpenGL works, palette.mp4.
"""

from experiments import backend

_GL = backend.choose()

import argparse  # the backend has to be chosen before mujoco is imported
import sys
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from agents import engines
from agents.palette_expert import PaletteExpert
from agents.video import open_video
from experiments import command, palette_figures, results
from experiments.palette_figures import Trace
from seal_gym.core.errors import ConfigError, RenderError
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.envs.palette_config import PaletteCfg
from seal_gym.envs.palette_env import PaletteEnv
from seal_gym.vision import palette_threshold
from seal_gym.vision.palette_seen import Observer

NAME = "palette"
HOPFIELD = "hopfield"
PERCEPTIONS = ("oracle", HOPFIELD, "threshold")
_FRAMES_S = 30
_INSET = (240, 288)  # width and height of the camera's picture in the video

Row = dict[str, Any]


def observer(name: str) -> Observer:
    """An observer by its name.

    Args:
        name: ``hopfield``, ``threshold`` or ``MODULE:FUNCTION``.

    Returns:
        It.

    Raises:
        ConfigError: If there is none of that name.
    """
    if name == HOPFIELD:
        return PaletteCfg().observer
    if name == "threshold":
        return palette_threshold.observe
    module, _, function = name.partition(":")
    try:
        found: Observer = getattr(import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"--perception {name!r}: must be one of {', '.join(PERCEPTIONS)} or MODULE:FUNCTION of an "
            f"observer ({error})"
        ) from error
    return found


def make(perception: str, render_mode: str | None = None) -> PaletteEnv:
    """The environment of a kind of perception.

    Args:
        perception: ``oracle`` or an observer's name.
        render_mode: Of the environment.

    Returns:
        The environment.
    """
    if perception == "oracle":
        return PaletteEnv(control="joint", perception="oracle", render_mode=render_mode)
    return PaletteEnv(
        control="joint", perception="vision", observer=observer(perception), render_mode=render_mode
    )


def play(env: PaletteEnv, seed: int, pictures: list[NDArray[np.uint8]] | None = None) -> tuple[Row, Trace]:
    """One episode of the scripted policy.

    Args:
        env: The environment.
        seed: Of the palette.
        pictures: Every second frame is appended.

    Returns:
        The metrics, and the run.
    """
    policy, memory, done = PaletteExpert.of(env), None, False
    observation, info = env.reset(seed=seed)
    seen_mm = _seen_mm(env)
    tips, commands, forces, home = [], [], [], []
    while True:
        tips.append(env.tip.pose[0, :3, 3].copy())
        commands.append(tip_kinematics(env.arm.q_command, env.arm.qd_command).pose[0, :3, 3])
        forces.append(info["force_n"])
        if done:
            break
        if pictures is not None and len(tips) % 2 == 1:
            pictures.append(_frame(env, info))
        action, memory = policy.predict(observation, memory)
        before = info["targets_done"]
        observation, _, terminated, truncated, info = env.step(action)
        home += [len(tips) * env.cfg.cell.timing.frame_s] * (info["targets_done"] - before)
        done = terminated or truncated
    time_s = np.arange(len(tips), dtype=np.float64) * env.cfg.cell.timing.frame_s
    metrics = info["episode_metrics"] | seen_mm | {"completed": info["is_success"]}
    return metrics, Trace(time_s, np.array(tips), np.array(commands), home, np.array(forces))


def _seen_mm(env: PaletteEnv) -> Row:
    """What perception told the policy against the truth."""
    away = 1e3 * np.linalg.norm(env.place_m[:, None, :2] - env.target_m[:, :2], axis=2)
    found = (away < 10.0).any(axis=0) if away.size else np.zeros(len(env.target_m), np.bool_)
    return {
        "missed": int((~found).sum()),
        "invented": int((away.min(axis=1) >= 10.0).sum()) if away.size else 0,
        "place_error_mm": float(away.min(axis=0)[found].max()) if found.any() else None,
    }


def run(perception: str, seed: int) -> Row:
    """One trial.

    Args:
        perception: See ``make``.
        seed: Of the palette.

    Returns:
        Its metrics.
    """
    metrics, _ = play(make(perception), seed)
    return {"perception": perception, "seed": seed, **metrics}


def summarise(rows: list[Row]) -> list[Row]:
    """A row for each kind of perception.

    Args:
        rows: From ``run``.

    Returns:
        Rates with Wilson's intervals, means with bootstrap intervals.
    """
    table = []
    for perception in dict.fromkeys(r["perception"] for r in rows):
        mine = [r for r in rows if r["perception"] == perception]
        targets, done = (sum(r[k] for r in mine) for k in ("targets", "targets_done"))
        row: Row = {"perception": perception, "trials": len(mine), "seed0": min(r["seed"] for r in mine)}
        for name, count, of in (
            ("completed", sum(r["completed"] for r in mine), len(mine)),
            ("touched", sum(r["wrong_touches"] > 0 for r in mine), len(mine)),
            ("timeout", sum(r["timeout"] for r in mine), len(mine)),
            ("collision", sum(r["collision"] for r in mine), len(mine)),
            ("home", done, targets),
        ):
            row[f"{name}_pct"] = 100.0 * count / of
            row[f"{name}_ci"] = results.wilson(count, of)
        row["targets"] = targets
        row["wrong_touches"] = sum(r["wrong_touches"] for r in mine)
        for key in ("path_mm", "peak_jerk_m_s3", "peak_force_n", "time_s"):
            values = [float(r[key]) for r in mine]
            row[key], row[f"{key}_ci"] = float(np.mean(values)), results.bootstrap(values)
        row["missed"], row["invented"] = (sum(r[k] for r in mine) for k in ("missed", "invented"))
        errors = [r["place_error_mm"] for r in mine if r["place_error_mm"] is not None]
        row["place_error_mm"] = max(errors) if errors else None
        table.append(row)
    return table


def markdown(rows: list[Row]) -> str:
    """The table.

    Args:
        rows: From ``summarise``.

    Returns:
        Markdown.
    """
    head = ["perception", "palettes", "completed %", "with wrong touches %", "wrong touches", "ties home %"]
    head += [
        "path mm",
        "peak jerk m/s^3",
        "peak force N",
        "time s",
        "ties missed / invented",
        "largest place error mm",
    ]
    body = [
        [
            r["perception"],
            str(r["trials"]),
            results.with_interval(r, "completed_pct", 1),
            results.with_interval(r, "touched_pct", 1),
            str(r["wrong_touches"]),
            results.with_interval(r, "home_pct", 2),
            results.with_interval(r, "path_mm", 0),
            results.with_interval(r, "peak_jerk_m_s3", 2),
            results.with_interval(r, "peak_force_n", 1),
            results.with_interval(r, "time_s", 2),
            f"{r['missed']} / {r['invented']} of {r['targets']}",
            results.number(r["place_error_mm"], 2),
        ]
        for r in rows
    ]
    return (
        "Completed: all ties home and no wrong touch. Path: of the tip; jerk: of the commanded tip; means "
        "over all trials.\n\n" + results.grid(head, body)
    )


def _frame(env: PaletteEnv, info: Row) -> NDArray[np.uint8]:
    """The cell with the camera's picture and the score."""
    picture = env.render()
    assert picture is not None
    out = picture.copy()
    small = cv2.resize(env.picture.rgb, _INSET, interpolation=cv2.INTER_AREA)
    out[16 : 16 + _INSET[1], -16 - _INSET[0] : -16] = small
    text = (
        f"t = {env.pressing.frames / _FRAMES_S:4.1f} s   ties home {info['targets_done']} of "
        f"{info['targets']}   wrong touches {info['wrong_touches']}   force {info['force_n']:3.0f} N"
    )
    cv2.rectangle(out, (0, out.shape[0] - 40), (out.shape[1], out.shape[0]), (28, 30, 34), -1)
    cv2.putText(
        out, text, (16, out.shape[0] - 13), cv2.FONT_HERSHEY_SIMPLEX, 0.65, (235, 235, 235), 1, cv2.LINE_AA
    )
    return out


def video(path: Path, perception: str, seed: int) -> None:
    """Films one run, at twice real time.

    Args:
        path: The MP4.
        perception: An observer's name.
        seed: Of the palette.

    Raises:
        RenderError: If no picture can be made here.
    """
    frames: list[NDArray[np.uint8]] = []
    env = make(perception, "rgb_array")
    play(env, seed, frames)
    env.close()
    with open_video(path) as writer:
        for frame in frames:
            writer.append_data(frame)


def figures(out: Path, perception: str, seed: int) -> None:
    """Makes the figures of one palette.

    Args:
        out: The folder.
        perception: An observer's name.
        seed: Of the palette.
    """
    env = make(perception)
    _, trace = play(env, seed)
    palette_figures.jerk(out / f"{NAME}_jerk.png", trace, seed)
    palette_figures.paths(out / f"{NAME}_tip.png", env, trace, seed)
    seeds = (seed, seed + 1)
    environments = [make(perception) for _ in seeds]
    for shown, k in zip(environments, seeds, strict=True):
        shown.reset(seed=k)
    palette_figures.segmentation(out / f"{NAME}_segmentation.png", environments, seeds)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.palette", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--trials", type=int, default=10, help="of each perception (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=500_000, help="of the first trial (default: %(default)s)")
    parser.add_argument(
        "--perception",
        action="append",
        help=f"{', '.join(PERCEPTIONS)} or MODULE:FUNCTION; may be repeated (default: the first three)",
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    parser.add_argument("--no-video", action="store_true", help="the figures need no OpenGL")
    return command.checked(parser, arguments, trials=1, jobs=1, seed=0)


def main(arguments: list[str] | None = None) -> int:
    """Makes table, figures and video.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)

    def do() -> str:
        perceptions = options.perception or PERCEPTIONS
        seen = [p for p in perceptions if p != "oracle"]
        for name in seen:
            observer(name)
        results.log_run(NAME, "Palettes", options.seed + options.trials - 1)
        seeds, rows = list(range(options.seed, options.seed + options.trials)), []
        for perception in perceptions:
            work = partial(run, perception)
            done = engines.local(options.jobs)(work, seeds)
            by_seed = dict(tqdm(done, total=len(seeds), desc=perception))
            rows += [by_seed[seed] for seed in seeds]
        table = summarise(rows)
        text = markdown(table)
        results.write(options.out, NAME, table, rows, renderer="raycast", regime="static", text=text)
        shown = seen[0] if seen else HOPFIELD
        figures(options.out, shown, options.seed)
        if not options.no_video:
            try:
                if _GL == "disabled":
                    raise RenderError("OpenGL is missing here")
                video(options.out / f"{NAME}.mp4", shown, options.seed)
            except RenderError as error:
                sys.stderr.write(f"no video: {error}\n")
        return text

    return command.run(do, options.out)


if __name__ == "__main__":
    sys.exit(main())
