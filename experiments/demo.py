"""The main job: a policy seals the three nominal parts and one seam of the user's.

    python -m experiments.demo --out out/demo

Writes a table, a video and a plot for each part, and ``demo.json`` with every trial. Videos and plots are of
the first seed once more, from the arm's home to the seam and back.
"""

from experiments import backend

_GL = backend.choose()

import argparse  # the backend has to be chosen before mujoco is imported
import sys
from pathlib import Path

from tqdm import tqdm

import agents
from agents import engines
from experiments import command, results, trials
from experiments.pictures import Recorder
from seal_gym.core.errors import RenderError, SealGymError
from seal_gym.envs.config import PERCEPTIONS, RENDERERS
from seal_gym.workpieces.catalogue import NAMES

_SEAM = Path(__file__).resolve().parent / "data" / "s_curve.csv"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(prog="python -m experiments.demo", description=__doc__.splitlines()[0])
    parser.add_argument("--policy", default="rmp_expert", choices=sorted(agents.POLICIES))
    parser.add_argument(
        "--workpiece",
        action="append",
        choices=NAMES,
        help="a nominal part; may be repeated (default: all three)",
    )
    parser.add_argument(
        "--seam", type=Path, help="a seam of yours: CSV with rows x,y,z,ax,ay,az in m (default: an S-curve)"
    )
    parser.add_argument("--perception", default=PERCEPTIONS[0], choices=PERCEPTIONS)
    parser.add_argument("--renderer", default=RENDERERS[0], choices=RENDERERS, help="of the sensor images")
    parser.add_argument("--seed", type=int, default=500_000, help="of the first trial (default: %(default)s)")
    parser.add_argument("--trials", type=int, default=1, help="a part (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder (default: %(default)s)")
    parser.add_argument("--no-video", action="store_true", help="no videos; the plots need no OpenGL")
    options = command.checked(parser, arguments, trials=1, jobs=1, seed=0)
    if options.seam and options.seam.suffix != ".csv":
        parser.error(f"--seam {options.seam}: must be a .csv file with rows x,y,z,ax,ay,az in m")
    return options


def parts(options: argparse.Namespace) -> list[str]:
    """The workpieces to seal.

    Args:
        options: The command line.

    Returns:
        Names and seam files, for ``Trial.workpiece``.
    """
    chosen = list(dict.fromkeys(options.workpiece or ([] if options.seam else NAMES)))
    if options.seam:
        chosen.append(str(options.seam))
    elif not options.workpiece:
        chosen.append(str(_SEAM))
    return chosen


def show(trial: trials.Trial, out: Path, *, video: bool) -> bool:
    """Runs a trial once more with pictures, the arm coming from its home and going back there.

    Args:
        trial: What to run.
        out: The folder.
        video: Whether to make a video.

    Returns:
        Whether the video could be made, if one was asked for.
    """
    recorder, made = Recorder(video=video), video
    try:
        trials.run(trial, recorder, "rgb_array" if video else None, from_home=True)
    except RenderError as error:
        sys.stderr.write(f"no video: {error}\n")
        recorder, made = Recorder(video=False), False
        trials.run(trial, recorder, from_home=True)
    if recorder.frames:
        recorder.write_video(out / f"{trial.part}.mp4")
    recorder.plot(out / f"{trial.part}.png", f"{trial.part}, {trial.method}, seed {trial.seed}")
    return made


def main(arguments: list[str] | None = None) -> int:
    """Runs the demo.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    env = {"perception": options.perception, "renderer": options.renderer}
    try:
        chosen = parts(options)
        for name in chosen:
            trials.workpiece(name)  # a bad seam is refused before anything runs
        wanted = [
            trials.Trial(method=options.policy, workpiece=name, seed=options.seed + k, env=env)
            for name in chosen
            for k in range(options.trials)
        ]
        engine = engines.local(options.jobs)
        rows = trials.run_all(wanted, engine=engine, log=options.out / "demo.trials.jsonl", title="sealing")
        summary = results.summarise(rows)
        renderer = options.renderer if options.perception == "vision" else "none"
        results.write(options.out, "demo", summary, rows, renderer=renderer, regime="static")
        video = not options.no_video
        if video and _GL == "disabled":
            sys.stderr.write(
                "no videos: OpenGL is missing here (Debian, Ubuntu: apt-get install libegl1 libgl1 "
                "libgl1-mesa-dri)\n"
            )
            video = False
        for trial in tqdm(wanted[:: options.trials], desc="pictures", unit="part"):
            video = show(trial, options.out, video=video) and video
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    sys.stdout.write(f"\n{results.table(summary)}\n\nwritten to {options.out}/\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
