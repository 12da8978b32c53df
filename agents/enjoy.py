"""Plays any policy and says how it went.

    python -m agents.enjoy --policy rmp_expert --env SealGym/Cylinder-v0 --episodes 3 --video out/expert.mp4

``--policy`` takes a name (``rmp_expert``, ...), a ``.safetensors`` file of ``agents.train_bc`` or
``agents.train_sb3`` (or the folder of such a run), or a ``.zip`` that Stable-Baselines3 saved. Nothing in
such a file is executed.
"""

from agents import backend

_GL = backend.choose()

import argparse  # noqa: E402  # the backend has to be chosen before mujoco is imported
import sys  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import gymnasium as gym  # noqa: E402
import numpy as np  # noqa: E402

import agents  # noqa: E402
import seal_gym  # noqa: E402
from agents import Policy  # noqa: E402
from seal_gym.core.errors import SealGymError  # noqa: E402
from seal_gym.envs.config import PERCEPTIONS  # noqa: E402

VIDEO_EVERY = 5  # frames: at 30 pictures a second, five times real time


def find_policy(name: str) -> Policy:
    """A policy by name or path.

    Args:
        name: As ``agents.load_policy`` takes it; also the folder of a run of ``agents.train_sb3``.

    Returns:
        The policy.

    Raises:
        SealGymError: If there is none.
    """
    folder = Path(name)
    return agents.load_policy(str(folder / "policy.safetensors") if folder.is_dir() else name)


def play(
    policy: Policy,
    env: Any,
    seed: int,
    watch: Callable[[Any], None] | None = None,
) -> dict[str, Any]:
    """Plays one episode.

    Args:
        policy: The policy.
        env: With the policy's control mode.
        seed: Of the episode.
        watch: Called after the reset and after each step.

    Returns:
        ``episode_metrics``, with ``return`` (the sum of rewards) and ``seed``.
    """
    observation, info = env.reset(seed=seed)
    state, start, total, done = None, np.array([True]), 0.0, False
    if watch:
        watch(env)
    while not done:
        action, state = policy.predict(observation, state=state, episode_start=start)
        observation, reward, terminated, truncated, info = env.step(action)
        total, start, done = total + float(reward), np.array([False]), terminated or truncated
        if watch:
            watch(env)
    return {**info["episode_metrics"], "return": total, "seed": seed}


class Film:
    """Writes each fifth picture of an environment to an MP4 (H.264): ``watch`` for ``play``.

    The file is opened with the first picture: where none can be made, there is none.
    """

    def __init__(self, path: Path) -> None:
        """Takes the name.

        Args:
            path: The file.
        """
        self._path = path
        self._writer: Any = None
        self._frames = 0

    def __call__(self, env: Any) -> None:
        """Takes a picture if it is time for one.

        Args:
            env: With ``render_mode="rgb_array"``.

        Raises:
            RenderError: If this machine cannot make pictures.
        """
        self._frames += 1
        if (self._frames - 1) % VIDEO_EVERY:
            return
        picture: Any = env.render()
        if self._writer is None:
            import imageio.v2 as imageio

            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = imageio.get_writer(
                self._path, fps=30, codec="libx264", quality=7, macro_block_size=8, pixelformat="yuv420p"
            )
        self._writer.append_data(picture)

    def close(self) -> None:
        """Ends the file."""
        if self._writer is not None:
            self._writer.close()


def film(policy: Policy, env_id: str, kwargs: dict[str, Any], seed: int, path: Path) -> dict[str, Any]:
    """Plays one episode and writes a video of it.

    Args:
        policy: The policy.
        env_id: Of the environment.
        kwargs: Of the environment.
        seed: Of the episode.
        path: The MP4 file.

    Returns:
        As ``play``.

    Raises:
        RenderError: If this machine cannot make pictures.
    """
    env: Any = gym.make(env_id, render_mode="rgb_array", disable_env_checker=True, **kwargs)
    camera = Film(path)
    try:
        return play(policy, env, seed, camera)
    finally:
        camera.close()
        env.close()


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(prog="python -m agents.enjoy", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--policy",
        default="rmp_expert",
        help=f"one of {', '.join(sorted(agents.POLICIES))}, a .safetensors file, a run's folder, or a .zip "
        "of Stable-Baselines3; default: %(default)s",
    )
    parser.add_argument(
        "--env",
        default=seal_gym.ENV_IDS[0],
        choices=seal_gym.ENV_IDS,
        metavar="ID",
        help="(default: %(default)s)",
    )
    parser.add_argument(
        "--perception", default=PERCEPTIONS[0], choices=PERCEPTIONS, help="(default: %(default)s)"
    )
    parser.add_argument("--episodes", type=int, default=1, help="(default: %(default)s)")
    parser.add_argument(
        "--seed", type=int, default=500_000, help="of the first episode (default: %(default)s)"
    )
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--video", type=Path, metavar="FILE", help="an MP4 of the first episode; needs OpenGL")
    shown.add_argument("--human", action="store_true", help="watch in MuJoCo's viewer; needs a screen")
    options = parser.parse_args(arguments)
    if options.episodes < 1 or options.seed < 0:
        parser.error("--episodes must be at least 1, --seed at least 0")
    if options.video and options.video.suffix != ".mp4":
        parser.error(f"--video {options.video}: must end in .mp4")
    return options


def line(row: dict[str, Any]) -> str:
    """An episode in one line.

    Args:
        row: From ``play``.

    Returns:
        Text.
    """
    rmse = "-" if row["rmse_mm"] is None else f"{row['rmse_mm']:.4f}"
    return (
        f"seed {row['seed']}: {row['outcome']}, RMSE {rmse} mm, whole {row['rmse_whole_mm']:.4f} mm, "
        f"coverage {row['coverage_pct']:.1f} %, {row['time_s']:.2f} s, return {row['return']:.2f}"
    )


def main(arguments: list[str] | None = None) -> int:
    """Plays.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if all was played.
    """
    options = parse(arguments)
    try:
        policy = find_policy(options.policy)
        kwargs = {"control": policy.control, "perception": options.perception}
        env: Any = gym.make(
            options.env, render_mode="human" if options.human else None, disable_env_checker=True, **kwargs
        )
        rows: list[dict[str, Any]] = []
        for seed in range(options.seed, options.seed + options.episodes):
            if options.video and not rows:
                rows.append(film(policy, options.env, kwargs, seed, options.video))
            else:
                rows.append(play(policy, env, seed))
            print(line(rows[-1]))
        env.close()
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    reached = [row for row in rows if row["reached"]]
    share = f"{len(reached)} of {len(rows)} reached"
    measured = [row["rmse_mm"] for row in reached if row["rmse_mm"] is not None]
    print(f"{share}, mean RMSE {np.mean(measured):.4f} mm" if measured else share)
    if options.video:
        print(f"video in {options.video}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
