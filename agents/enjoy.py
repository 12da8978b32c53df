"""Plays any policy and says how it went.

    python -m agents.enjoy --policy rmp_expert --env SealGym/Cylinder-v0 --episodes 3 --video out/expert.mp4

``--policy`` takes a name (``rmp_expert``, ...), a ``.safetensors`` file of ``agents.train_bc`` or
``agents.train_sb3`` (or the folder of such a run), or a ``.zip`` that Stable-Baselines3 saved. Only the last
kind can hold code, which loading would run: open such a file only if you trust where it comes from.
"""

from agents import backend

_GL = backend.choose()

import argparse  # noqa: E402  # the backend has to be chosen before mujoco is imported
import json  # noqa: E402
import sys  # noqa: E402
import zipfile  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import gymnasium as gym  # noqa: E402
import numpy as np  # noqa: E402

import agents  # noqa: E402
import seal_gym  # noqa: E402
from agents import Policy  # noqa: E402
from seal_gym.core.errors import ConfigError, SealGymError, require  # noqa: E402
from seal_gym.envs.adapters import CONTROLS  # noqa: E402
from seal_gym.envs.config import PERCEPTIONS  # noqa: E402

VIDEO_EVERY = 5  # frames: at 30 pictures a second, five times real time
_CONTROL_BY_SIZE = {6: "tip", 27: "rmp"}


def policy_at(path: Path, control: str | None = None) -> Policy:
    """A policy from a file or a folder.

    Args:
        path: ``NAME.safetensors``, a run's folder, or SB3's ``NAME.zip``.
        control: What the policy's action means; from the file by default.

    Returns:
        The policy.

    Raises:
        ConfigError: If it is none of these.
    """
    if path.is_dir():
        path = path / "policy.safetensors"
    if path.suffix == ".zip":
        return _from_zip(path, control)
    require(
        path.suffix == ".safetensors",
        f"policy = {str(path)!r}: must be one of {sorted(agents.POLICIES)}, a .safetensors file, a run's "
        "folder or a .zip of Stable-Baselines3",
    )
    from agents import sb3_policies

    reader = sb3_policies.cloned_policies() if _is_cloned(path) else sb3_policies
    policy: Policy = reader.load(path)
    require(
        control in (None, policy.control), f"control = {control!r}: {path.name} acts with {policy.control!r}"
    )
    return policy


def _is_cloned(path: Path) -> bool:
    """Whether a card is one of a behaviour-cloned policy; a broken card is left for its reader to refuse."""
    card = path.with_suffix(".json")
    try:
        known = json.loads(card.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(known, dict) and known.get("format") == "seal_gym policy"


def _from_zip(path: Path, control: str | None) -> Policy:
    from stable_baselines3 import PPO, SAC

    from agents.sb3_policies import Sb3Policy

    require(path.is_file(), f"policy = {str(path)!r}: no such file")
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise ConfigError(f"{path.name} is no zip of Stable-Baselines3, or a broken one ({error})") from error
    kind = next((k for name, k in (("clip_range", PPO), ("target_entropy", SAC)) if name in data), None)
    if kind is None:
        raise ConfigError(
            f"{path.name} was saved by neither PPO nor SAC: load it yourself with its own class"
        )
    # Schedules are pickled functions, which need not load on another Python, and which nobody needs here.
    unused = {"learning_rate": 0.0, "lr_schedule": _zero, "clip_range": _zero, "clip_range_vf": None}
    model = kind.load(path, device="cpu", custom_objects=unused)
    assert model.action_space.shape is not None
    known = control or _CONTROL_BY_SIZE.get(model.action_space.shape[0])
    if known is None:
        raise ConfigError(f"{path.name} gives {model.action_space.shape} actions: no control mode takes them")
    return Sb3Policy(model.policy, known)


def _zero(_: float) -> float:
    return 0.0


def find_policy(name: str, control: str | None = None) -> Policy:
    """A policy by name or path.

    Args:
        name: One of ``agents.POLICIES``, or a path for ``policy_at``.
        control: What a file's actions mean.

    Returns:
        The policy.

    Raises:
        ConfigError: If there is none.
    """
    if name in agents.POLICIES:
        require(
            control in (None, agents.control_of(name)),
            f"control = {control!r}: policy {name!r} acts with {agents.control_of(name)!r}",
        )
        return agents.load_policy(name)
    return policy_at(Path(name), control)


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
        "of Stable-Baselines3 (loading a .zip can run code in it: only open one you trust); default: "
        "%(default)s",
    )
    parser.add_argument(
        "--env",
        default=seal_gym.ENV_IDS[0],
        choices=seal_gym.ENV_IDS,
        metavar="ID",
        help="(default: %(default)s)",
    )
    parser.add_argument(
        "--control", choices=CONTROLS, help="what a .zip's actions mean (default: by their number)"
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
        policy = find_policy(options.policy, options.control)
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
