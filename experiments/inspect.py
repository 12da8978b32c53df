"""One run to look into: what the cameras saw, what perception made of it, what each leaf wanted.

    python -m experiments.inspect --workpiece rectangular --out out/inspect

Writes a Rerun recording (``rerun <file>.rrd``; needs the extra ``viz``) and a picture that sums the run up.
"""

from experiments import backend

_GL = backend.choose()

import argparse  # the backend has to be chosen before mujoco is imported
import sys
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

import agents
from experiments import command, recording, trials
from experiments.pictures import FeatureTrace, plot_features
from seal_gym.core.frames import Array
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.envs.adapters import ArmState, RmpAdapter
from seal_gym.envs.core import SealCore
from seal_gym.envs.seal_env import SealEnv
from seal_gym.rmp import TipRmp, reference_twist, seam_policies
from seal_gym.vision import overlay
from seal_gym.vision.features import RoiFeatures, ViewGeometry, oracle_lines, update_features
from seal_gym.workpieces.seam import seam_in_world

_MM, _DEG = 1e3, float(np.rad2deg(1.0))
_TIP_ACCEL = slice(17, 23)  # in the observation
# What ``seal_gym.rmp.seam_policies`` gives, in its order: the expert's leaves before it sums them.
SEAM_LEAVES = ("attraction_front", "heading_front", "attraction_side", "heading_side", "forward_speed")


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One camera frame of a run.

    Attributes:
        time_s: Since the reset [s].
        arc_m: Arc length of the seam's point nearest the tip [m].
        tip_error_m: Distance from the tip to the desired path [m].
        tip_pose: ``T_base_tip``, shape (4, 4), m.
        part_pose: ``T_base_part``, shape (4, 4), m.
        true: Features from the true geometry, of one simulation.
        seen: Features as perception gave them.
        images: The ROIs, front and side, shape (height, width, 3).
        snr_db: Signal-to-noise ratio of either, shape (2,), dB.
        marks: What perception made of either.
        true_marks: The true seam in either.
        leaves: What each leaf on the tip wants, by name; empty where the control mode resolves none, and in
            the last frame.
    """

    time_s: float
    arc_m: float
    tip_error_m: float
    tip_pose: Array
    part_pose: Array
    true: RoiFeatures
    seen: RoiFeatures
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    snr_db: Array
    marks: tuple[overlay.ViewMarks, overlay.ViewMarks]
    true_marks: tuple[overlay.ViewMarks, overlay.ViewMarks]
    leaves: dict[str, TipRmp]


def look(core: SealCore) -> Frame:
    """Takes down where a core of one simulation is; changes nothing in it.

    Args:
        core: After ``observe``.

    Returns:
        The frame, without leaves.
    """
    views = ViewGeometry.of(core.cfg.cell)
    point, tangent = seam_in_world(core.scene.workpiece.seam, core.progress.s, core.arm.part_pose)
    truth = oracle_lines(point, tangent, core.tip.pose, views)
    true = RoiFeatures.zeros(1)
    update_features(true, truth, views)
    # The same frame has the same noise: these are the images that perception saw.
    images = core.sensors.images(core.tip.pose, core.arm, core.frames)
    shown = (images.front[0], images.side[0])
    stages = None
    if core.cfg.perception == "vision":
        stages = overlay.line_stage(*shown, core.sensors.nozzle, views)
    return Frame(
        time_s=core.seconds(0),
        arc_m=float(core.progress.s[0]),
        tip_error_m=float(core.progress.error_m[0]),
        tip_pose=core.tip.pose[0].copy(),
        part_pose=core.arm.part_pose[0].copy(),
        true=true,
        seen=deepcopy(core.features),
        images=shown,
        snr_db=images.snr_db[0].copy(),
        marks=overlay.view_marks(core.lines, views, 0, stages),
        true_marks=overlay.view_marks(truth, views),
        leaves={},
    )


def leaves(
    core: SealCore, observation: NDArray[np.float32], action: NDArray[np.float32]
) -> dict[str, TipRmp]:
    """What each leaf on the tip wants of a core of one simulation; changes nothing in it.

    Args:
        core: Before the step.
        observation: That the action answers, shape (FEATURES,).
        action: Shape (27,).

    Returns:
        The expert's leaves on what perception says, then what the adapter resolves: the policy's leaf and the
        fixed ones, each of one simulation. Empty if the control mode resolves none.
    """
    if not isinstance(core.adapter, RmpAdapter):
        return {}
    arm = core.arm
    state = ArmState(
        q=arm.q_command,
        qd=arm.qd_command,
        tip=tip_kinematics(arm.q_command, arm.qd_command),
        errors=core.errors,
        seam_twist=core.seam_twist,
        tip_accel=observation[None, _TIP_ACCEL].astype(np.float64),
        part_pose=arm.part_pose,
        seen=np.asarray(core.features.valid.all(axis=1)),
    )
    # As the expert: without a line there is no going on.
    speed = core.cfg.cell.process.speed_m_s if core.features.valid[0].all() else 0.0
    reference = reference_twist(speed, core.seam_twist)
    wanted = seam_policies(core.errors, core.tip.twist, reference)
    resolved = core.adapter.tip_policies(action[None].astype(np.float64), state)
    return {**dict(zip(SEAM_LEAVES, wanted, strict=True)), **resolved}


def watch(env: SealEnv, policy: agents.Policy, seed: int) -> Iterator[Frame]:
    """Runs an episode.

    Args:
        env: Where.
        policy: Acts in it.
        seed: Of the episode.

    Yields:
        Each frame, with what the leaves want in it.
    """
    core = env.core
    observation, _ = env.reset(seed=seed)
    state, start, done = None, np.array([True]), False
    while not done:
        action, state = policy.predict(observation, state=state, episode_start=start)
        yield replace(look(core), leaves=leaves(core, observation, action))
        observation, _, terminated, truncated, _ = env.step(action)
        start, done = np.array([False]), terminated or truncated
    yield look(core)


def trace(frames: list[Frame], corners_m: Array) -> FeatureTrace:
    """Puts a run's numbers side by side.

    Args:
        frames: Of the run.
        corners_m: Arc-length intervals of the seam's corners, shape (k, 2), m.

    Returns:
        What the picture shows.
    """

    def pick(which: str, name: str, scale: float) -> Array:
        return np.array([scale * getattr(getattr(f, which), name)[0] for f in frames])

    return FeatureTrace(
        arc_mm=np.array([_MM * f.arc_m for f in frames]),
        true_d_mm=pick("true", "d_m", _MM),
        seen_d_mm=pick("seen", "d_m", _MM),
        true_theta_deg=pick("true", "theta_rad", _DEG),
        seen_theta_deg=pick("seen", "theta_rad", _DEG),
        error_px=pick("seen", "d_px", 1.0) - pick("true", "d_px", 1.0),
        valid=np.array([f.seen.valid[0] for f in frames]),
        tip_error_mm=np.array([_MM * f.tip_error_m for f in frames]),
        snr_db=np.array([f.snr_db for f in frames]),
        corners_mm=_MM * corners_m,
    )


def report(found: FeatureTrace) -> str:
    """Root mean square errors of the run's features, as text.

    Args:
        found: The run's numbers.

    Returns:
        A table; from 10 mm of travel on, of frames with the view valid.
    """
    rows = ["view    d [mm]   d [px]  theta [deg]  valid [%]  SNR [dB]"]
    going = found.sealing
    for v, view in enumerate(("front", "side")):
        used = going & found.valid[:, v]
        errors = (found.d_error_mm[:, v], found.error_px[:, v], found.theta_error_deg[:, v])
        d, px, theta = (float(np.sqrt(np.mean(e[used] ** 2))) if used.any() else np.nan for e in errors)
        share = 100.0 * found.valid[going, v].mean() if going.any() else np.nan
        snr = found.snr_db[:, v].mean()
        rows.append(f"{view:<5} {d:8.3f} {px:8.3f} {theta:12.3f} {share:10.1f} {snr:9.1f}")
    tip = float(np.sqrt(np.mean(found.tip_error_mm[going] ** 2))) if going.any() else np.nan
    return "\n".join([*rows, f"tip error {tip:.3f} mm RMS from 10 mm of travel on"])


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.inspect", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--policy", default="rmp_expert", choices=sorted(agents.POLICIES))
    command.add_run(parser, "out/inspect")
    return command.checked(parser, arguments, every=1, seed=0)


def environment(options: argparse.Namespace) -> SealEnv:
    """The environment of the run.

    Args:
        options: The command line.

    Returns:
        With the control mode that the policy needs.

    Raises:
        SealGymError: If the policy, the workpiece or the renderer cannot be had.
    """
    return SealEnv(
        workpiece=trials.workpiece(str(options.seam or options.workpiece)),
        control=agents.control_of(options.policy),
        perception=options.perception,
        renderer=options.renderer,
    )


def inspect(options: argparse.Namespace) -> FeatureTrace:
    """Runs the episode and writes the files.

    Args:
        options: The command line.

    Returns:
        The run's numbers.

    Raises:
        SealGymError: If the workpiece or the renderer cannot be had.
    """
    name = str(options.seam or options.workpiece)
    trial = trials.Trial(method=options.policy, workpiece=name, seed=options.seed)
    stem = f"{trial.part}_{options.perception}_{options.seed}"
    env = environment(options)
    scene = env.core.scene
    writer = None
    if (missing := recording.missing()) is None:
        writer = recording.Writer(options.out / f"{stem}.rrd", stem, scene)
    else:
        sys.stderr.write(f"no recording: {missing}\n")
    frames: list[Frame] = []
    worst: tuple[float, Frame] | None = None
    policy = agents.load_policy(options.policy, env)
    for k, frame in enumerate(tqdm(watch(env, policy, options.seed), desc=stem, unit="frame")):
        if writer:
            writer.add(k, frame, full=k % options.every == 0)
        error = float(np.abs(frame.seen.d_m - frame.true.d_m).max())
        if frame.arc_m >= 0.01 and (worst is None or error > worst[0]):
            worst = (error, frame)
        frames.append(replace(frame, images=(np.empty(0, np.uint8),) * 2, leaves={}))
    env.close()
    if writer:
        writer.close()
    found = trace(frames, scene.workpiece.seam.corners)
    shown = worst[1] if worst else frame
    pictures = [overlay.draw(*pair, scale=5) for pair in zip(shown.images, shown.marks, strict=True)]
    title = f"{trial.part}, {options.policy}, {options.perception}, seed {options.seed}"
    plot_features(options.out / f"{stem}.png", title, found, pictures, _MM * shown.arc_m)
    return found


def main(arguments: list[str] | None = None) -> int:
    """Runs the inspection.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    return command.run(lambda: report(inspect(options)), options.out)


if __name__ == "__main__":
    sys.exit(main())
