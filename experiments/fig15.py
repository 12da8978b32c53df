"""A run on a part that turns and shifts: frames of it, and its error on the part.

    python -m experiments.fig15 --policy neural_rmp --workpiece rectangular --seed 500000 --out out/fig15

Writes frames of the run with what was displaced so far (the idea of Zhou et al., Fig. 15), the tip error
along the path on the moving part (Fig. 14), a video, and a JSON file with the numbers of each frame shown.
The regime is the dynamic one of Table 4; ``--severity`` scales it.
"""

from experiments import backend

_GL = backend.choose()

import argparse  # the backend has to be chosen before mujoco is imported
import sys
from pathlib import Path
from typing import Any

import numpy as np

import agents
from experiments import command, results, trials
from experiments.pictures import Recorder, draw_frames, plot_on_part
from seal_gym.core.errors import RenderError
from seal_gym.core.frames import Array
from seal_gym.envs.config import PERCEPTIONS
from seal_gym.workpieces import catalogue
from seal_gym.wrappers import dynamic_regime

NAME = "fig15"
FRAMES = 6


def displacement(pose: Array, start: Array) -> tuple[float, float]:
    """How far a part has gone.

    Args:
        pose: ``T_base_part``, shape (4, 4), m.
        start: The same at the start.

    Returns:
        Displacement of its origin in the plane of the table [mm], and rotation about the vertical, in
        (-180, 180] [deg].
    """
    turned = pose[:3, :3] @ start[:3, :3].T
    shift = 1e3 * float(np.linalg.norm(pose[:2, 3] - start[:2, 3]))
    return shift, float(np.rad2deg(np.arctan2(turned[1, 0], turned[0, 0])))


def shown(run: Recorder) -> list[int]:
    """Which frames to show: evenly spaced in time, the first and the last among them.

    Args:
        run: A recorded run.

    Returns:
        Indices into its lists, at most ``FRAMES``.
    """
    return sorted({round(k) for k in np.linspace(0, len(run.time_s) - 1, FRAMES)})


def numbers(run: Recorder, k: int) -> dict[str, float]:
    """What a frame shows.

    Args:
        run: A recorded run.
        k: Index of the frame.

    Returns:
        A row of the table.
    """
    shift, turn = displacement(run.part_pose[k], run.part_pose[0])
    return {
        "time_s": round(run.time_s[k], 3),
        "s_mm": round(run.s_mm[k], 3),
        "shift_mm": round(shift, 3),
        "yaw_deg": round(turn, 3),
        "tip_error_mm": round(float(run.error_mm[k]), 4),
    }


def record(trial: trials.Trial) -> tuple[Recorder, dict[str, Any]]:
    """Runs a trial under observation.

    Args:
        trial: What to run.

    Returns:
        The recorded run, with pictures where OpenGL is; and the trial's row.
    """
    if _GL != "disabled":
        run = Recorder(video=True)
        try:
            return run, trials.run(trial, run, "rgb_array")
        except RenderError as error:
            sys.stderr.write(f"no frames: {error}\n")
    run = Recorder(video=False)
    return run, trials.run(trial, run)


def make(options: argparse.Namespace) -> str:
    """Writes the files.

    Args:
        options: The command line.

    Returns:
        The table for people.
    """
    part, out = options.workpiece, options.out
    trial = trials.Trial(
        method=options.policy,
        workpiece=part,
        seed=options.seed,
        env={
            "perception": options.perception,
            "renderer": "raycast",
            "disturbances": dynamic_regime(options.severity),
        },
    )
    run, row = record(trial)
    rows = [numbers(run, k) for k in shown(run)]
    title = f"{part}, {options.policy}, seed {options.seed}: {row['outcome']}"
    plot_on_part(out / f"fig14_{part}.png", title, catalogue.get(part).surface, run)
    pictures = [f"fig14_{part}.png"]
    if run.frames:
        captions = [
            f"t = {r['time_s']:.1f} s    part shifted {r['shift_mm']:.0f} mm, turned {r['yaw_deg']:+.0f} deg"
            f"    tip error {r['tip_error_mm']:.2f} mm"
            for r in rows
        ]
        draw_frames(out / f"{NAME}_{part}.png", title, run, shown(run), captions)
        run.write_video(out / f"{NAME}_{part}.mp4")
        pictures.insert(0, f"{NAME}_{part}.png")
    table = results.grid(
        ["time s", "along the seam mm", "part shifted mm", "turned deg", "tip error mm"],
        [[f"{r['time_s']:.2f}", f"{r['s_mm']:.1f}", f"{r['shift_mm']:.1f}", f"{r['yaw_deg']:+.1f}",
          f"{r['tip_error_mm']:.3f}"] for r in rows],
    )  # fmt: skip
    text = f"{title}\n\n{table}\n\n" + "\n\n".join(f"![{p}]({p})" for p in pictures)
    results.write(
        out,
        f"{NAME}_{part}",
        rows,
        [row],
        renderer="raycast" if options.perception == "vision" else "none",
        regime="dynamic",
        text=text,
        module=NAME,
    )
    return table


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{NAME}", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--policy", default="neural_rmp", choices=sorted(agents.POLICIES))
    parser.add_argument("--workpiece", default="rectangular", choices=catalogue.NAMES)
    parser.add_argument("--perception", default=PERCEPTIONS[0], choices=PERCEPTIONS)
    parser.add_argument("--severity", type=float, default=1.0, help="of the regime (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=500_000, help="of the run (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    return command.checked(parser, arguments, seed=0)


def main(arguments: list[str] | None = None) -> int:
    """Makes the figure.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    return command.run(lambda: make(options), options.out)


if __name__ == "__main__":
    sys.exit(main())
