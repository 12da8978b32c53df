"""What a policy asked for along a seam: its accelerations and metrics, where it insists and where it yields.

    python -m experiments.explain --policy neural_rmp --workpiece rectangular --seed 500000 --out out/explain

Writes a picture (the idea of Zhou et al., Fig. 15) and a Rerun recording (``rerun <file>.rrd``; needs the
extra ``viz``). With ``control="rmp"`` the policy's leaf (f, A) is shown beside the fixed leaves it is
resolved with; with ``control="tip"`` there are accelerations only.

The share of the leaf. In the tip's space the resolved acceleration is ``a = sum_k W_k f_k`` with
``W_k = (sum A)^-1 A_k``, but for the damping near singularities, joint limits and leaves of yours, which act
elsewhere. The diagonal of the policy's W is its share on each axis: at 1 it alone decides, at 0 the fixed
leaves do.
"""

from experiments import backend

_GL = backend.choose()

import argparse  # noqa: E402  # the backend has to be chosen before mujoco is imported
import sys  # noqa: E402
from collections.abc import Iterator, Sequence  # noqa: E402
from dataclasses import replace  # noqa: E402
from importlib import import_module  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any, NamedTuple  # noqa: E402

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from tqdm import tqdm  # noqa: E402

import agents  # noqa: E402
from agents.episodes import tip_acceleration, tip_scale  # noqa: E402
from experiments import inspect, recording, trials  # noqa: E402
from experiments.explain_plot import AXES, Story, plot_story  # noqa: E402
from seal_gym.core.errors import ConfigError, SealGymError  # noqa: E402
from seal_gym.core.frames import Array  # noqa: E402
from seal_gym.envs.adapters import RmpAdapter, TipAdapter  # noqa: E402
from seal_gym.envs.config import PERCEPTIONS, RENDERERS  # noqa: E402
from seal_gym.envs.core import SealCore  # noqa: E402
from seal_gym.envs.seal_env import SealEnv  # noqa: E402
from seal_gym.rmp import TipRmp  # noqa: E402
from seal_gym.sim.scene import Scene  # noqa: E402
from seal_gym.workpieces.catalogue import NAMES  # noqa: E402

_MM, _DEG = 1e3, float(np.rad2deg(1.0))
_PARTS = (("translation", "m_s2", slice(0, 3)), ("rotation", "rad_s2", slice(3, 6)))
_RGB = ((214, 60, 50), (50, 160, 70), (60, 110, 220))  # x, y, z, as the axes in the viewer
_RESOLVED_RGB = (0, 220, 220)
_LOWER = np.tril_indices(6)
ABOUT = f"""# What the policy asked for

Scrub the timeline below; `time` is in seconds of the simulation, `frame` counts camera frames.

**translation, rotation**: at the tip, in the tip frame (x red, right of travel; y green, along it; z blue,
back along the nozzle).

- An arrow is an acceleration: {_MM * recording.ACCEL_S2:.0f} mm for 1 m/s^2,
  {_MM * recording.ANGULAR_M_S2:.0f} mm for 1 rad/s^2 about the arrow. White: what the policy wants, f;
  cyan: what the tip was told to do, all leaves resolved; the others: the fixed leaves.
- An ellipsoid is a metric A, long where the leaf insists: half axes of {_MM * recording.METRIC_M:.0f} mm
  times the root of each eigenvalue of the 3x3 block. A policy with `control="tip"` has none: it is always
  obeyed.

**plots**: f and the resolved acceleration, the diagonal of A, the policy's share against the fixed leaves
(1: it alone decides; 0: they do), features, the tip's error.

**front, side, cell**: as in `experiments.inspect`: images with the edge candidates (orange), the true seam
(green), RANSAC's line (blue), the tracked one (white); part, true seam, path so far.
"""


class Decision(NamedTuple):
    """What a policy asked for in a frame of one simulation, and what became of it."""

    policies: dict[str, TipRmp]
    """The leaves on the tip by name: ``policy``, and with ``control="rmp"`` the fixed ones. Batch of one."""
    resolved: Array
    """Tip acceleration that the joints were told, J qdd + Jdot qd [m/s^2, rad/s^2]. Shape (6,)."""

    @property
    def accel(self) -> Array:
        """The policy's f [m/s^2, rad/s^2]. Shape (6,)."""
        return np.asarray(self.policies["policy"].accel[0])

    @property
    def metric(self) -> Array:
        """The policy's A; zero if it has none. Shape (6, 6)."""
        return np.asarray(self.policies["policy"].metric[0])

    @property
    def share(self) -> Array:
        """The policy's share on each axis; 1 if it has no metric: there is nothing beside it. Shape (6,)."""
        if len(self.policies) == 1:
            return np.ones(len(AXES))
        total = sum((p.metric[0] for p in self.policies.values()), np.zeros((6, 6)))
        return np.asarray(np.diagonal(np.linalg.solve(total, self.metric)))


def decide(core: SealCore, action: NDArray[np.float32]) -> Decision:
    """What an action means in a core of one simulation; changes nothing in it.

    Args:
        core: Before the step.
        action: As the policy gave it.

    Returns:
        The decision.

    Raises:
        ConfigError: If actions are joint accelerations: they ask for nothing at the tip.
    """
    state, adapter = core.arm_state(), core.adapter
    given = np.clip(action[None].astype(np.float64), -1.0, 1.0)
    if isinstance(adapter, RmpAdapter):
        policies = adapter.tip_policies(given, state)
    elif isinstance(adapter, TipAdapter):
        policies = {"policy": TipRmp(given * tip_scale(core.cfg.cell), np.zeros((1, 6, 6)))}
    else:
        raise ConfigError(f"control = {core.cfg.control!r}: only 'rmp' and 'tip' act at the tip")
    return Decision(policies, tip_acceleration(adapter(given, state), state)[0])


def watch(
    env: SealEnv, policy: agents.Policy, seed: int, ended: dict[str, Any]
) -> Iterator[tuple[inspect.Frame, Decision]]:
    """Runs an episode.

    Args:
        env: Where.
        policy: Acts in it.
        seed: Of the episode.
        ended: Filled with ``episode_metrics`` at the end.

    Yields:
        Each frame in which the policy acted, and what it decided.
    """
    observation, _ = env.reset(seed=seed)
    state, start, done = None, np.array([True]), False
    while not done:
        action, state = policy.predict(observation, state=state, episode_start=start)
        decision = decide(env.core, action)
        yield replace(inspect.look(env.core), leaves=decision.policies), decision
        observation, _, terminated, truncated, info = env.step(action)
        start, done = np.array([False]), terminated or truncated
    ended.update(info["episode_metrics"])


class Writer(recording.Writer):
    """Adds what the policy decided to a recording."""

    about = ABOUT

    def __init__(self, path: Path, name: str, scene: Scene, metrics: bool) -> None:
        """Opens the file.

        Args:
            path: The .rrd file.
            name: Of the recording.
            scene: The run's part, cell and nozzle.
            metrics: Whether the policy has a metric.
        """
        self._metrics = metrics
        super().__init__(path, name, scene)
        rr, colours = self._rr, [list(c) for c in _RGB]
        pale = [[(c + 255) // 2 for c in colour] for colour in _RGB]
        for kind, unit, part in _PARTS:
            names = list(AXES[part])
            wanted = rr.SeriesLines(colors=pale, names=[f"f {n}" for n in names], widths=[1.0] * 3)
            told = rr.SeriesLines(colors=colours, names=[f"resolved {n}" for n in names], widths=[2.0] * 3)
            self._fixed(f"decision/{kind}_{unit}/f", wanted)
            self._fixed(f"decision/{kind}_{unit}/resolved", told)
            for entity in ("metric", "share") if metrics else ():
                lines = rr.SeriesLines(colors=colours, names=names, widths=[1.5] * 3)
                self._fixed(f"{entity}/{kind}", lines)

    def decide(self, decision: Decision, *, full: bool) -> None:
        """Writes a decision into the frame that was added last.

        Args:
            decision: To write.
            full: With arrows.
        """
        rr = self._rr
        scales = {"translation": recording.ACCEL_S2, "rotation": recording.ANGULAR_M_S2}
        for kind, unit, part in _PARTS:
            self._stream.log(f"decision/{kind}_{unit}/f", rr.Scalars(decision.accel[part]))
            self._stream.log(f"decision/{kind}_{unit}/resolved", rr.Scalars(decision.resolved[part]))
            if self._metrics:
                self._stream.log(f"metric/{kind}", rr.Scalars(np.diagonal(decision.metric)[part]))
                self._stream.log(f"share/{kind}", rr.Scalars(decision.share[part]))
            if not full:
                continue
            entity, scale = f"world/tip/{kind}", scales[kind]
            self._arrow(f"{entity}/resolved/accel", scale * decision.resolved[part], _RESOLVED_RGB)
            if not self._metrics:  # with a metric, the arrow comes with its ellipsoid
                self._arrow(f"{entity}/policy/accel", scale * decision.accel[part], (255, 255, 255))
        if self._metrics:
            self._stream.log("policy/metric", rr.Scalars(decision.metric[_LOWER]))

    def _layout(self, scene: Scene) -> Any:
        return recording.blueprint(scene, self._plots())

    def _plots(self) -> Sequence[Any]:
        b = import_module("rerun.blueprint")
        plots = [
            b.TimeSeriesView(
                origin=f"decision/{kind}_{unit}",
                name=f"f and resolved [{unit.replace('_s2', '/s^2')}]",
                # The approach, ten times larger, is cut off: zoom out to see it.
                axis_y=b.ScalarAxis(range=(-reach, reach)),
            )
            for (kind, unit, _), reach in zip(_PARTS, (0.1, 10.0), strict=True)
        ]
        for entity, name in (
            (("metric", "diagonal of A"), ("share", "share of the policy")) if self._metrics else ()
        ):
            views = [
                b.TimeSeriesView(origin=f"{entity}/{kind}", name=f"{name}: {kind}") for kind, _, _ in _PARTS
            ]
            plots.append(b.Tabs(*views))
        features = [
            b.TimeSeriesView(origin=f"features/{f}_{view}_{unit}", name=f"{f} {view} [{unit}]")
            for f, unit in (("d", "mm"), ("theta", "deg"))
            for view in recording.VIEWS
        ]
        error = b.TimeSeriesView(
            origin="tip/error_mm", name="tip error [mm]", axis_y=b.ScalarAxis(range=(0.0, 0.5))
        )
        return [*plots, b.Tabs(*features), error]


def story(frames: list[tuple[inspect.Frame, Decision]], corners_m: Array, stand_off_path_m: Array) -> Story:
    """Puts a run's numbers side by side.

    Args:
        frames: Of the run, with decisions.
        corners_m: Arc-length intervals of the seam's corners, shape (k, 2), m.
        stand_off_path_m: The desired path of the tip in the part's frame, shape (n, 3), m.

    Returns:
        What the picture shows.
    """
    looked, decided = [f for f, _ in frames], [d for _, d in frames]
    poses = np.array([np.linalg.solve(f.part_pose, f.tip_pose) for f in looked])
    fixed = [sum((p.metric[0] for p in list(d.policies.values())[1:]), np.zeros((6, 6))) for d in decided]
    return Story(
        arc_mm=_MM * np.array([f.arc_m for f in looked]),
        tip_pose=poses,
        desired_mm=_MM * stand_off_path_m,
        tip_error_mm=_MM * np.array([f.tip_error_m for f in looked]),
        accel=np.array([d.accel for d in decided]),
        resolved=np.array([d.resolved for d in decided]),
        metric=np.array([d.metric for d in decided]),
        fixed_metric=np.array(fixed),
        share=np.array([d.share for d in decided]),
        has_metric=len(decided[0].policies) > 1,
        d_mm=_MM * np.array([f.seen.d_m[0] for f in looked]),
        theta_deg=_DEG * np.array([f.seen.theta_rad[0] for f in looked]),
        valid=np.array([f.seen.valid[0] for f in looked]),
        corners_mm=_MM * corners_m,
    )


def report(found: Story) -> str:
    """Where the policy insists and where it yields, as text.

    Args:
        found: The run's numbers.

    Returns:
        Root mean squares of f and of the resolved acceleration, means of the diagonal of A and of the share,
        on each axis, for the approach (up to 10 mm of travel), the straights and the corners.
    """
    in_corner = found.in_corner
    regions = {
        "approach": ~found.sealing,
        "along": found.sealing & ~in_corner,
        "corners": found.sealing & in_corner,
    }
    rows = [f"{'':<20}" + "".join(f"{name:>10}" for name in AXES)]
    for region, used in regions.items():
        if not used.any():
            continue
        values = {
            "f, RMS": np.sqrt(np.mean(found.accel[used] ** 2, axis=0)),
            "resolved, RMS": np.sqrt(np.mean(found.resolved[used] ** 2, axis=0)),
        }
        if found.has_metric:
            values["diagonal of A"] = np.diagonal(found.metric[used], axis1=1, axis2=2).mean(axis=0)
            values["share"] = found.share[used].mean(axis=0)
        rows.append(f"{region}, {used.sum()} frames")
        rows += [f"  {name:<18}" + "".join(f"{v:10.4f}" for v in row) for name, row in values.items()]
    return "\n".join(rows)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.explain", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--policy",
        default="neural_rmp",
        help=f"one of {', '.join(sorted(agents.POLICIES))}, or the path of weights (default: %(default)s)",
    )
    parser.add_argument("--workpiece", default="rectangular", choices=NAMES, help="(default: %(default)s)")
    parser.add_argument(
        "--seam", type=Path, help="a seam of yours instead: CSV with rows x,y,z,ax,ay,az in m"
    )
    parser.add_argument("--perception", default="vision", choices=PERCEPTIONS, help="(default: %(default)s)")
    parser.add_argument("--renderer", default=RENDERERS[0], choices=RENDERERS, help="of the sensor images")
    parser.add_argument("--seed", type=int, default=500_000, help="of the run (default: %(default)s)")
    parser.add_argument(
        "--every",
        type=int,
        default=2,
        help="record each n-th frame's images and arrows (default: %(default)s)",
    )
    parser.add_argument("--out", type=Path, default=Path("out/explain"), help="folder (default: %(default)s)")
    options = parser.parse_args(arguments)
    for name, least in (("every", 1), ("seed", 0)):
        if getattr(options, name) < least:
            parser.error(f"--{name} {getattr(options, name)}: must be at least {least}")
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"--out {options.out}: is a file, must be a folder")
    return options


def explain(options: argparse.Namespace) -> Story:
    """Runs the episode and writes the files.

    Args:
        options: The command line.

    Returns:
        The run's numbers.

    Raises:
        SealGymError: If the policy, the workpiece or the renderer cannot be had.
    """
    part = str(options.seam or options.workpiece)
    short = trials.Trial(method=options.policy, workpiece=part, seed=options.seed).part
    name = Path(options.policy).stem
    stem = f"{short}_{name}_{options.perception}_{options.seed}"
    env = SealEnv(
        workpiece=trials.workpiece(part),
        control=agents.control_of(options.policy),
        perception=options.perception,
        renderer=options.renderer,
    )
    policy = agents.load_policy(options.policy, env)
    core = env.core
    scene, seam = core.scene, core.scene.workpiece.seam
    writer = None
    if (missing := recording.missing()) is None:
        writer = Writer(options.out / f"{stem}.rrd", stem, scene, isinstance(core.adapter, RmpAdapter))
    else:
        sys.stderr.write(f"no recording: {missing}\n")
    frames: list[tuple[inspect.Frame, Decision]] = []
    ended: dict[str, Any] = {}
    for k, (frame, decision) in enumerate(
        tqdm(watch(env, policy, options.seed, ended), desc=stem, unit="frame")
    ):
        full = k % options.every == 0
        if writer:
            writer.add(k, frame, full=full)
            writer.decide(decision, full=full)
        frames.append((replace(frame, images=(np.empty(0, np.uint8),) * 2), decision))
    env.close()
    if writer:
        writer.close()
    sealed = seam.at(np.linspace(0.0, seam.length, 1000))
    found = story(frames, seam.corners, sealed.position + scene.cell.process.stand_off_m * sealed.approach)
    title = f"{short}, {name}, {options.perception}, seed {options.seed}, ended: {ended['outcome']}"
    plot_story(options.out / f"{stem}.png", title, found)
    return found


def main(arguments: list[str] | None = None) -> int:
    """Runs the command.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        found = explain(options)
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    sys.stdout.write(f"\n{report(found)}\n\nwritten to {options.out}/\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
