"""The one implementation of the sealing environment: N simulations at once. Every face drives this."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from seal_gym.core.errors import ActionError, ConfigError
from seal_gym.core.frames import Array, axis_angle, cross, tip_rotation, transform, yaw_pose
from seal_gym.core.kinematics import HOME_Q, TipKinematics, tip_kinematics
from seal_gym.envs.adapters import ArmState, LeafFunction, RmpAdapter, check_leaf_function, make_adapter
from seal_gym.envs.config import SealCfg
from seal_gym.envs.extrusion import ROWS as SEALANT_ROWS
from seal_gym.envs.extrusion import Extrusion
from seal_gym.envs.journey import Journey
from seal_gym.envs.sensors import Sensors
from seal_gym.estimation.seam_rate import SeamRate
from seal_gym.planning import ik
from seal_gym.rmp import SeamErrors
from seal_gym.sealant.config import SealantCfg
from seal_gym.sim.arm import ArmBatch
from seal_gym.sim.raycast import Images
from seal_gym.sim.reach import check_reach
from seal_gym.sim.scene import Scene, cached_scene
from seal_gym.tasks.progress import Progress
from seal_gym.tasks.reward import reward
from seal_gym.vision.features import RoiFeatures, SeamLines, ViewGeometry, oracle_lines, update_features
from seal_gym.vision.perception import GrooveCfg, Perception
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.seam import seam_in_world
from seal_gym.wrappers.base import DisturbanceCfg
from seal_gym.wrappers.catalogue import disturbances
from seal_gym.wrappers.moving_obstacle import MovingObstacleCfg, Obstacle
from seal_gym.wrappers.stack import Disturbances

Observation = NDArray[np.float32] | dict[str, NDArray[Any]]

_MM, _DEG = 1e3, float(np.rad2deg(1.0))
_TWIST = np.array([_MM] * 3 + [_DEG] * 3)
_SEEN_TWIST = (0, 2, 3, 5)  # what the views can show of the seam's twist: not the motion along y
# Name, scale from SI, bound after scaling, count: the observation's rows, in order.
OBSERVATION_ROWS = (
    ("d_front_mm", _MM, 100.0, 1),
    ("theta_front_deg", _DEG, 180.0, 1),
    ("valid_front", 1.0, 1.0, 1),
    ("d_side_mm", _MM, 100.0, 1),
    ("theta_side_deg", _DEG, 180.0, 1),
    ("valid_side", 1.0, 1.0, 1),
    ("seam_vx_vz_mm_s", _MM, 1e3, 2),
    ("seam_wx_wz_deg_s", _DEG, 1e3, 2),
    ("lean_deg", _DEG, 180.0, 1),
    ("tip_v_mm_s", _MM, 5e3, 3),
    ("tip_w_deg_s", _DEG, 2e3, 3),
    ("tip_accel_m_s2", 1.0, 50.0, 3),
    ("tip_accel_rad_s2", 1.0, 500.0, 3),
    ("q_rad", 1.0, 10.0, 6),
    ("qd_rad_s", 1.0, 10.0, 6),
)
_BOUND = np.concatenate([np.full(n, bound) for _, _, bound, n in OBSERVATION_ROWS])
_IS_FLAG = np.concatenate([np.full(n, name.startswith("valid")) for name, _, _, n in OBSERVATION_ROWS])
_LOWER = np.where(_IS_FLAG, 0.0, -_BOUND)
FEATURES = len(_BOUND)
_X, _Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
_MAX_DRAWS = 1000
_FLANK_PX = 2.0


class StepResult(NamedTuple):
    """What a frame brought, for N simulations.

    Attributes:
        reward: Shape (N,).
        reached: The seam is sealed, shape (N,).
        collision: Something was touched, shape (N,).
        lost: The tip is too far from the path, shape (N,).
        timeout: None of these within the time limit, shape (N,).
    """

    reward: Array
    reached: NDArray[np.bool_]
    collision: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    timeout: NDArray[np.bool_]

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """Reached, collision or lost, shape (N,)."""
        return self.reached | self.collision | self.lost


class SealCore:
    """N sealing cells, stepped together; rows never mix, so N = 1 and N > 1 give the same numbers.

    Attributes:
        scene: The compiled scene.
        features: ROI features, brought up to date each frame.
        tip: Kinematics of the measured motion.
        progress: Where the tips are along the seam.
        arm: The physics.
        lines: The seam's line in each view, as perception found it last.
        frames: Frames since each simulation's reset, shape (N,).
        journey: Guns that started at home.
        action_size: Of an action.
        extrusion: Guns and beads; None without sealant.
    """

    def __init__(self, cfg: SealCfg, n: int) -> None:
        """Allocates the simulations; ``reset`` every row before the first ``step``.

        Args:
            cfg: How the environment is put together.
            n: Number of simulations.

        Raises:
            SeamError: If this cell cannot seal the workpiece.
        """
        cell, task = cfg.cell, cfg.task
        self.cfg, self.n = cfg, n
        workpiece = catalogue.get(cfg.workpiece)
        self.scene: Scene = cached_scene(workpiece, cell, _obstacle_m(cfg.disturbances))
        by_vision = cfg.perception == "vision"
        free = cached_scene(workpiece, cell)
        self._reach = check_reach(free, task.part_shift_m, task.part_yaw_rad, by_vision=by_vision)
        self._seam = self.scene.workpiece.seam
        self.arm = ArmBatch(self.scene, n, cfg.threads)
        self.adapter = make_adapter(cfg.control, cell, cfg.leaves, cfg.sealing)
        self.progress = Progress(self._seam, cell.process.stand_off_m, n, task)
        self.sensors = Sensors(self.scene, cfg, n)
        laid = cfg.sealant
        self.extrusion = Extrusion(cfg, laid, self.scene, n) if isinstance(laid, SealantCfg) else None
        self.action_size = self.adapter.size + (self.extrusion is not None)
        self._disturbances = Disturbances(cfg.disturbances, n, self.action_size, self.scene)
        self._views = ViewGeometry.of(cell)
        self._images: Images | None = None
        self._rate = SeamRate(n, cell.timing.frame_s, cfg.seam_rate_gain)
        self.features = RoiFeatures.zeros(n)
        self.lines = SeamLines(np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2), np.bool_))
        self.tip: TipKinematics = tip_kinematics(self.arm.q, self.arm.qd)
        self._command = self.tip
        self._tip_accel = np.zeros((n, 6))
        self._action = np.zeros((n, self.action_size))
        self._lean = np.zeros(n)
        self.frames = np.zeros(n, np.int64)
        self.journey = Journey(n)
        start = self._seam.at(0.0)
        self._start = transform(
            tip_rotation(start.tangent, start.approach),
            start.position + cell.process.stand_off_m * start.approach,
        )
        self._vision = self._eyes() if cfg.perception == "vision" else None
        self._lower, self._upper = _LOWER, _BOUND
        if self.extrusion is not None:
            self._lower = np.concatenate((_LOWER, np.zeros(len(SEALANT_ROWS))))
            self._upper = np.concatenate((_BOUND, [bound for _, _, bound in SEALANT_ROWS]))
            if self._vision is not None:
                self.extrusion.watch(self.sensors.nozzle[1])
        self._lean_taught = float(np.arctan2(self._start[2, 0], self._start[2, 2]))
        nominal_s = self._seam.length / cell.process.speed_m_s
        rate = cell.timing.frame_rate_hz
        self.time_limit = int(np.ceil(task.time_factor * nominal_s * rate))
        self._journey_limit = int(np.ceil(task.journey_s * rate))

    def _eyes(self) -> Perception:
        cfg, width = self.cfg, self.scene.workpiece.groove_width
        return Perception(
            self.n,
            self._views,
            self.sensors.nozzle,
            cfg.cell.timing.frame_s,
            cfg.vision,
            plate=self._start[2, :3],  # the part's z axis in the taught tip frame
            groove=GrooveCfg(width_m=width, depth_m=width) if width else None,
            sealant_rgb=cfg.sealant.fluid.rgb if isinstance(cfg.sealant, SealantCfg) else None,
            threads=cfg.threads,
        )

    # -- spaces -----------------------------------------------------------------------------------------

    @property
    def action_space(self) -> spaces.Box:
        """Of one environment."""
        return spaces.Box(-1.0, 1.0, (self.action_size,), np.float32)

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """Of one environment."""
        low, high = self._lower.astype(np.float32), self._upper.astype(np.float32)
        features = spaces.Box(low, high, dtype=np.float32)
        if self.cfg.observation == "features":
            return features
        images = {c.name: spaces.Box(0, 255, (c.height, c.width, 3), np.uint8) for c in self.cfg.cell.cameras}
        return spaces.Dict({"features": features, **images})

    # -- running ----------------------------------------------------------------------------------------

    def reset(self, i: int, rng: np.random.Generator, start: str = "hover") -> None:
        """Starts a new episode in one simulation: displaces the part, puts the gun in its hover or at home.

        Args:
            i: Which simulation.
            rng: Draws pose, start and look, always in the same order.
            start: ``"hover"``, or ``"home"``: the same hover is where the gun then has to go first.
        """
        task = self.cfg.task
        shift = rng.uniform(-task.part_shift_m, task.part_shift_m, 2)
        yaw = rng.uniform(-task.part_yaw_rad, task.part_yaw_rad)
        part_pose = self._reach.part_pose @ yaw_pose(shift[0], shift[1], 0.0, yaw)
        hovering = self._hover(i, part_pose, rng)
        self.journey.reset(i, part_pose @ hovering, hovering[:3, 3], start)
        if start == "home":
            self._go_home(i, part_pose)
        row = tip_kinematics(self.arm.q[i : i + 1], self.arm.qd[i : i + 1])
        for values, new in zip(self.tip, row, strict=True):
            values[i] = new[0]
        self.sensors.reset(i, rng)
        self._disturbances.reset(i, rng, part_pose, self.sensors.look)
        self.progress.reset(i, hovering[:3, 3])
        self._rate.reset(i)
        if self._vision is not None:
            self._vision.reset(i)
        self.features.clear(i)
        self._tip_accel[i] = 0.0
        self._action[i] = 0.0
        self.frames[i] = 0
        if self.obstacle is not None:
            self.arm.place_obstacle(i, self.obstacle.position[i])
        if self.extrusion is not None:
            self.extrusion.reset(i, hovering[:3, 3], float(self.progress.s[i]), rng)

    def _hover(self, i: int, part_pose: Array, rng: np.random.Generator) -> Array:
        """Puts the gun in a hover where it touches nothing; gives ``T_part_tip``."""
        for _ in range(_MAX_DRAWS):
            hovering = self._draw_hover(rng)
            q = ik.nearest(ik.solve(part_pose @ hovering), self._reach.start_q)
            if np.isnan(q).any():
                continue
            self.arm.reset(i, q, part_pose)
            if not self.arm.contacts(i):
                return hovering
        raise ConfigError(
            f"no start in {_MAX_DRAWS} draws is free of contact and within the arm's reach: begin the seam "
            "where there is more room, or reduce SealTaskCfg's hover_m, sideways_m or turned_rad"
        )

    def _go_home(self, i: int, part_pose: Array) -> None:
        self.arm.reset(i, HOME_Q, part_pose)
        if touching := self.arm.contacts(i):
            raise ConfigError(
                f"start = 'home': {' and '.join(touching[0])} touch there: this part is in the way of the "
                "arm's posture of rest; use start='hover'"
            )

    def _draw_hover(self, rng: np.random.Generator) -> Array:
        """``T_part_tip`` of a start from which both ROIs see the seam, drawn until one does.

        An edge in the outermost pixels shows one of its sides only: it is not seen.
        """
        task, seam, views = self.cfg.task, self._seam, self._views.inside(_FLANK_PX)
        for _ in range(_MAX_DRAWS):
            hover = rng.uniform(*task.hover_m)
            sideways = rng.uniform(-task.sideways_m, task.sideways_m)
            about_z, about_x = rng.uniform(-task.turned_rad, task.turned_rad, 2)
            turn = axis_angle(_Z, about_z) @ axis_angle(_X, about_x)
            pose = self._start @ transform(turn, np.array([sideways, 0.0, hover]))
            seen = seam.at(self.progress.locate(pose[:3, 3])[1])
            if oracle_lines(seen.position[None], seen.tangent[None], pose[None], views).valid.all():
                return pose
        raise ConfigError(
            f"no start in {_MAX_DRAWS} draws has the seam in both ROIs: reduce hover_m = {task.hover_m}, "
            f"sideways_m = {task.sideways_m} or turned_rad = {task.turned_rad}"
        )

    def step(self, action: NDArray[Any]) -> StepResult:
        """Advances all simulations by one frame; call ``observe`` for what they then see.

        Args:
            action: Shape (N, size); finite, clipped to [-1, 1].

        Returns:
            Rewards and outcomes.

        Raises:
            ActionError: If the action has a wrong shape or is not finite.
        """
        action = self._checked(action)
        delayed = self._disturbances.delayed(action)
        qdd = self.adapter(delayed[:, : self.adapter.size], self.arm_state())
        touched = self.arm.step(qdd, self._disturbances.outside(self.frames, self.progress.s))
        self.frames += 1
        self._track(qdd)
        before, error = self.progress.furthest, self.progress.error_m.copy()
        tip = self._on_the_seam()
        self.progress.advance(tip, self._seam_speed())
        if self.extrusion is not None:
            turn = np.swapaxes(self.arm.part_pose[:, :3, :3], 1, 2) @ self.tip.pose[:, :3, :3]
            # The valve is locked until the gun is there.
            pressure = np.where(self.journey.under_way, -1.0, delayed[:, -1])
            self.extrusion.step(pressure, tip, turn, self.progress.s)
        return self._judge(touched, action, before, error)

    def observe(self, rows: NDArray[np.bool_] | None = None) -> Observation:
        """Looks at the seam from where the tips are now.

        Args:
            rows: Simulations that look, shape (N,), all by default. The others have looked in this frame
                already: their estimates stay as they are.

        Returns:
            Features of shape (N, FEATURES), or a dict with the images as well; arrays of the caller's own.
        """
        self._perceive(rows)
        features = self._feature_rows()
        if self.cfg.observation == "features":
            return features
        images = self._images or self._look()
        return {"features": features, "front": images.front, "side": images.side}

    # -- the parts of a step ----------------------------------------------------------------------------

    def _checked(self, action: NDArray[Any]) -> Array:
        action = as_action(action, (self.n, self.action_size), self.cfg.control)
        if not np.isfinite(action).all():
            bad = np.argwhere(~np.isfinite(action))[0].tolist()
            raise ActionError(
                f"action{bad} = {action[tuple(bad)]}: must be finite; values beyond [-1, 1] are clipped"
            )
        return np.asarray(np.minimum(np.maximum(action, -1.0), 1.0), dtype=np.float64)

    def arm_state(self) -> ArmState:
        """What an adapter reads now: the commanded motion, so that the servo's lag stays out of its loop."""
        self._command = tip_kinematics(self.arm.q_command, self.arm.qd_command)
        return ArmState(
            q=self.arm.q_command,
            qd=self.arm.qd_command,
            tip=self._command,
            errors=self.errors,
            seam_twist=self._rate.twist,
            tip_accel=self._tip_accel,
            part_pose=self.arm.part_pose,
            seen=np.asarray(self.features.valid.all(axis=1)),
            obstacle=self.obstacle,
        )

    def _track(self, qdd: Array) -> None:
        command = self._command
        self._tip_accel = (command.jacobian @ qdd[:, :, None])[..., 0] + command.drift
        self.tip = tip_kinematics(self.arm.q, self.arm.qd)

    def tip_in_part(self) -> Array:
        """The tips in the parts' frames, shape (N, 3), m."""
        part = self.arm.part_pose
        offset = self.tip.pose[:, :3, 3] - part[:, :3, 3]
        return np.ascontiguousarray((offset[:, None] @ part[:, :3, :3])[:, 0])

    def _on_the_seam(self) -> Array:
        """The tips in the parts' frames; of guns on their way from home, where they are expected."""
        tip = self.tip_in_part()
        if not self.journey.under_way.any():
            return tip
        for i in self.journey.arrive(self.tip.pose):
            self.progress.reset(i, tip[i])
        return self.journey.held(tip)

    def _seam_speed(self) -> Array | None:
        """True speed of the seam's point nearest the tip a frame ago, shape (N,), m/s; None at rest."""
        twist = self.part_twist
        if twist is None:
            return None
        part = self.arm.part_pose
        point, _ = seam_in_world(self._seam, self.progress.s, part)
        velocity = twist[:, :3] + cross(twist[:, 3:], point - part[:, :3, 3])
        return np.asarray(np.sqrt((velocity**2).sum(axis=1)))

    def _judge(self, touched: NDArray[np.bool_], action: Array, before: Array, error: Array) -> StepResult:
        cell, progress = self.cfg.cell, self.progress
        reached = progress.reached & ~touched
        lost = progress.lost & ~touched
        limit = self.time_limit + np.where(self.journey.from_home, self._journey_limit, 0)
        timeout = (self.frames >= limit) & ~(touched | reached | lost)
        change = 0.5 * np.abs(action - self._action).mean(axis=1)
        self._action = action
        value = reward(
            (progress.furthest - before) / (cell.process.speed_m_s * cell.timing.frame_s),
            progress.error_m,
            error,
            np.abs(self.features.theta_rad).max(axis=1),
            change,
            reached,
            touched | lost,
            self.cfg.reward,
        )
        if self.extrusion is not None:
            value = value + self.extrusion.reward()
        return StepResult(value, reached, touched, lost, timeout)

    def _seam_lines(self, rows: NDArray[np.bool_] | None) -> SeamLines:
        """The one place where perception differs: the oracle projects the true seam into the views."""
        if self._vision is not None:
            self._images = self._look()
            return self._vision.update(self._images.front, self._images.side, self.tip.pose, rows)
        point, tangent = seam_in_world(self._seam, self.progress.s, self.arm.part_pose)
        lines = oracle_lines(point, tangent, self._disturbances.bracket(self.tip.pose), self._views)
        return self._disturbances.lines(lines, self.frames)

    def _exposed(self) -> Images:
        """The images as the cameras take them now."""
        self._disturbances.illuminate(self.sensors.look, self.frames)
        bead = None if self.extrusion is None else self.extrusion.view()
        return self.sensors.images(self._disturbances.bracket(self.tip.pose), self.arm, self.frames, bead)

    def _look(self) -> Images:
        """The images as they arrive now."""
        return self._disturbances.images(self._exposed(), self.frames)

    def _perceive(self, rows: NDArray[np.bool_] | None = None) -> None:
        looking = ~self.journey.under_way
        if not looking.all():
            rows = looking if rows is None else rows & looking
        self.lines = self._seam_lines(rows)
        self.lines.valid[~looking] = False
        update_features(self.features, self.lines, self._views)
        self._rate.update(
            self.features.point_m,
            self.features.direction,
            self.tip.pose,
            self.features.valid[:, 0] & self.features.valid[:, 1],
            rows,
        )
        lean = np.arctan2(self.tip.pose[:, 2, 0], self.tip.pose[:, 2, 2]) - self._lean_taught
        self._lean = np.mod(lean + np.pi, 2 * np.pi) - np.pi
        if self.extrusion is not None:
            self.extrusion.look(None if self._images is None else self._images.side, rows)

    def _feature_rows(self) -> NDArray[np.float32]:
        f, rows = self.features, np.empty((self.n, len(self._lower)))
        rows[:, 0], rows[:, 3] = _MM * f.d_m[:, 0], _MM * f.d_m[:, 1]
        rows[:, 1], rows[:, 4] = _DEG * f.theta_rad[:, 0], _DEG * f.theta_rad[:, 1]
        rows[:, 2], rows[:, 5] = f.valid[:, 0], f.valid[:, 1]
        rows[:, 6:10] = (_TWIST * self._rate.twist)[:, _SEEN_TWIST]
        rows[:, 10] = _DEG * self._lean
        rows[:, 11:17] = _TWIST * self.tip.twist
        rows[:, 17:23] = self._tip_accel
        rows[:, 23:29] = self.arm.q
        rows[:, 29:35] = self.arm.qd
        if self.extrusion is not None:
            rows[:, FEATURES:] = self.extrusion.rows()
        return np.asarray(np.minimum(np.maximum(rows, self._lower), self._upper), dtype=np.float32)

    # -- what others may ask ----------------------------------------------------------------------------

    @property
    def errors(self) -> SeamErrors:
        """Where the seam is in the tip frame, by the ROI features; each of shape (N,)."""
        f = self.features
        return SeamErrors(f.d_m[:, 0], f.theta_rad[:, 0], f.d_m[:, 1], f.theta_rad[:, 1], self._lean)

    @property
    def seam_twist(self) -> Array:
        """Estimated twist of the seam in the tip frame, shape (N, 6), m/s and rad/s."""
        return self._rate.twist

    @property
    def part_twist(self) -> Array | None:
        """True motion of the parts, for metrics and tests: policies are not told.

        Velocity of their origins and angular velocity in the base frame, shape (N, 6), m/s and rad/s; None if
        they stand still.
        """
        return self._disturbances.part_twist(self.frames)

    @property
    def obstacle(self) -> Obstacle | None:
        """Where ``MovingObstacle`` is; None if there is none."""
        return self._disturbances.obstacle(self.frames)

    @property
    def images(self) -> Images:
        """The images of this frame as perception got them; without vision, as the cameras take them."""
        return self._images or self._exposed()

    @property
    def snr_db(self) -> Array | None:
        """Signal-to-noise ratio of the observed images, shape (N, 2), dB; None without images."""
        blind = self.cfg.observation == "features" and self.cfg.perception == "oracle"
        return None if blind else self.sensors.snr_db

    def add_leaf(self, leaf: LeafFunction) -> None:
        """Adds an RMP leaf at run time.

        Args:
            leaf: Gives a ``Leaf`` from an ``ArmState``.

        Raises:
            ActionError: If the control mode resolves no leaves.
            ConfigError: If it is no function.
        """
        if not isinstance(self.adapter, RmpAdapter):
            raise ActionError(f"control = {self.cfg.control!r} resolves no leaves: use control='rmp'")
        check_leaf_function(leaf)
        self.adapter.leaves.append(leaf)

    def recorded(self) -> list[dict[str, Any]]:
        """The disturbances as ``disturbances`` takes them again.

        Returns:
            Ready for JSON.
        """
        return [d.to_dict() for d in self.cfg.disturbances]

    def disturbed(self, disturbance: object) -> "SealCore":
        """The same cells with one disturbance more, before their first reset.

        Args:
            disturbance: As ``SealCfg.disturbances`` takes them.

        Returns:
            A new core; leaves added at run time are kept.

        Raises:
            ConfigError: If it is wrong, or there is one of its kind.
        """
        leaves = tuple(self.adapter.leaves) if isinstance(self.adapter, RmpAdapter) else ()
        more = disturbances((*self.cfg.disturbances, disturbance))
        return SealCore(replace(self.cfg, leaves=leaves, disturbances=more), self.n)

    def seconds(self, i: int) -> float:
        """Simulated time of one episode.

        Args:
            i: Which simulation.

        Returns:
            Seconds since its reset.
        """
        return self._seconds(self.frames[i])

    def _seconds(self, frames: np.int64) -> float:
        return float(frames * self.cfg.cell.timing.frame_s)

    def episode_metrics(self, i: int, result: StepResult) -> dict[str, Any]:
        """Summary of an episode that has ended.

        Args:
            i: Which simulation.
            result: Of its last step.

        Returns:
            Outcome and metrics as protocol.md names them; ``rmse_mm`` is None if the tip did not come far
            enough: a NaN would not equal itself where infos are compared.
        """
        metrics = {k: None if np.isnan(v) else v for k, v in self.progress.metrics(i).items()}
        names = ("collision", "reached", "lost", "timeout")
        outcome = next((name for name in names if getattr(result, name)[i]), "running")
        return {
            "outcome": outcome,
            "reached": outcome == "reached",
            "collision": outcome == "collision",
            "timeout": outcome in ("timeout", "lost"),
            **metrics,
            "time_s": self.seconds(i),
            **({"journey_s": self._seconds(self.journey.frames[i])} if self.journey.from_home[i] else {}),
            **({} if self.extrusion is None else self.extrusion.metrics(i)),
        }

    def info(self, i: int, result: StepResult | None) -> dict[str, Any]:
        """The info dictionary of one simulation.

        Args:
            i: Which simulation.
            result: Of its last step, or None after a reset.

        Returns:
            See ``SealEnv``.
        """
        f = self.features
        collision = result is not None and bool(result.collision[i])
        reached = result is not None and bool(result.reached[i])
        info: dict[str, Any] = {
            "tip_error_mm": float(_MM * self.progress.error_m[i]),
            "progress": float(self.progress.share[i]),
            "collision": collision,
            "reached": reached,
            "is_success": reached,
            "renderer": self.cfg.renderer,
            "seam_velocity": self._rate.twist[i].copy(),
            "roi": roi_info(f, i),
        }
        if self.journey.from_home[i]:
            info["under_way"] = bool(self.journey.under_way[i])
            info["hover_pose"] = self.journey.hover[i].copy()
        if self.snr_db is not None:
            info["snr_db"] = self.snr_db[i].copy()
        if self.cfg.disturbances:
            info["disturbances"] = self.recorded()
        if self.obstacle is not None:
            info["obstacle"] = obstacle_info(self.obstacle, i)
        if self.extrusion is not None:
            info["sealant"] = self.extrusion.info(i)
        if result is not None and (result.terminated[i] or result.timeout[i]):
            info["episode_metrics"] = self.episode_metrics(i, result)
        return info


def _obstacle_m(cfgs: tuple[DisturbanceCfg, ...]) -> float:
    """Radius of the obstacle that a scene needs."""
    on = [c.radius_mm for c in cfgs if isinstance(c, MovingObstacleCfg) and c.severity > 0]
    return 1e-3 * sum(on)


def as_action(action: Any, shape: tuple[int, ...], control: str) -> Array:
    """An action as an array of numbers, whatever the user passed.

    Args:
        action: Numbers.
        shape: What it must be.
        control: Named in the error.

    Returns:
        Of that shape.

    Raises:
        ActionError: If it is something else.
    """
    try:
        array = np.asarray(action)
        real = array.dtype.kind in "biuf" or (array.dtype == object and array.astype(np.float64) is not None)
    except (TypeError, ValueError):
        array, real = np.empty(0), False
    if not real or array.shape != shape:
        given = f"shape {array.shape}" if real else f"no real numbers ({type(action).__name__})"
        raise ActionError(f"action has {given}: control={control!r} takes numbers of shape {shape}")
    return array.astype(np.float64)


def obstacle_info(obstacle: Obstacle, i: int) -> dict[str, Any]:
    """Where the obstacle of one simulation is.

    Args:
        obstacle: Of N simulations.
        i: Which one.

    Returns:
        ``position_m`` and ``velocity_m_s`` in the robot's base frame, and ``radius_m``.
    """
    return {
        "position_m": obstacle.position[i].copy(),
        "velocity_m_s": obstacle.velocity[i].copy(),
        "radius_m": obstacle.radius,
    }


def roi_info(f: RoiFeatures, i: int) -> dict[str, float | bool]:
    """The ROI features of one simulation by name.

    Args:
        f: Features of N simulations.
        i: Which one.

    Returns:
        For ``front`` and ``side``: ``d_<view>_mm``, ``theta_<view>_rad``, ``d_<view>_px``,
        ``theta_<view>_px_rad`` and ``valid_<view>``.
    """
    out: dict[str, float | bool] = {}
    for v, view in enumerate(("front", "side")):
        out[f"d_{view}_mm"] = float(_MM * f.d_m[i, v])
        out[f"theta_{view}_rad"] = float(f.theta_rad[i, v])
        out[f"d_{view}_px"] = float(f.d_px[i, v])
        out[f"theta_{view}_px_rad"] = float(f.theta_px_rad[i, v])
        out[f"valid_{view}"] = bool(f.valid[i, v])
    return out
