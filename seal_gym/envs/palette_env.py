"""``PaletteEnv``: a UR5 presses nylon ties home on a cable-harness palette."""

from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from seal_gym.core.errors import ActionError, ConfigError
from seal_gym.core.frames import Array, transform, yaw_pose
from seal_gym.core.kinematics import TipKinematics, tip_kinematics
from seal_gym.envs.adapters import JointAdapter, TipAdapter
from seal_gym.envs.core import as_action
from seal_gym.envs.palette_config import PaletteCfg
from seal_gym.envs.viewing import HEIGHT, WIDTH, check_render_mode
from seal_gym.planning import ik
from seal_gym.sim.arm import ArmBatch
from seal_gym.sim.look import Look
from seal_gym.sim.palette_scene import (
    BOARD_TOP_M,
    CLASSES,
    PaletteScene,
    build_palette,
    read_touches,
)
from seal_gym.sim.rgbd import Picture, RgbdCamera
from seal_gym.sim.scene import GROUP_COLLISION
from seal_gym.tasks.pressing import Events, Pressing, reward
from seal_gym.vision.palette_seen import targets_of
from seal_gym.workpieces.palette import MAX_TARGETS, draw_layout

_MM, _DEG = 1e3, float(np.rad2deg(1.0))
# Name, scale from SI, bound after scaling, count: the observation's rows, in order.
PALETTE_ROWS = (
    ("target_mm", _MM, 2e3, 3 * MAX_TARGETS),
    ("open", 1.0, 1.0, MAX_TARGETS),
    ("tip_v_mm_s", _MM, 5e3, 3),
    ("tip_w_deg_s", _DEG, 2e3, 3),
    ("tip_accel_m_s2", 1.0, 50.0, 3),
    ("tip_accel_rad_s2", 1.0, 500.0, 3),
    ("force_n", 1.0, 1e3, 1),
    ("q_rad", 1.0, 10.0, 6),
    ("qd_rad_s", 1.0, 10.0, 6),
)
_BOUND = np.concatenate([np.full(n, bound) for _, _, bound, n in PALETTE_ROWS])
_SCALE = np.concatenate([np.full(n, scale) for _, scale, _, n in PALETTE_ROWS])
_LOWER = np.where(
    np.concatenate([np.full(n, name in ("open", "force_n")) for name, _, _, n in PALETTE_ROWS]), 0.0, -_BOUND
)
POSTURE = np.radians([-4.0, -85.0, -115.0, -70.0, 90.0, -94.0])
"""The branch of the inverse kinematics the tool begins in: elbow up, tool down [rad]."""
WRONG = (*CLASSES, "other")
"""Classes of wrong touches; ``other``: the table, the arm itself, or a target by anything but the pad."""
_AT_TARGET_M = 0.02  # a press closes the open target nearest to the pad, if it is as near as this
_MAX_DRAWS = 100


class _Command(NamedTuple):
    """What an adapter reads."""

    tip: TipKinematics


class PaletteEnv(gym.Env[Any, NDArray[np.float32]], EzPickle):
    """A UR5 with a tie tool presses the nylon ties of a cable harness home and touches nothing else.

    ## Description

    A palette carries black cables between grey pegs, blue connectors, green rivets and white nylon ties, laid
    out anew at each reset; 4 to 8 of the ties stand open over red target zones, the others sit already. A
    tie is home when the pad presses it with 15 N or more at its seat, 6 mm down against a spring; it then
    locks. The palette lies within +-20 mm and +-15 deg of its nominal pose; the tool starts beside it.
    Source: Carvajal and Martinez-Garcia, "Robot arm planning and control by tau-Jerk theory and vision-based
    recurrent ANN observer", sections I, IV and V; forces, sizes and colours are this project's.

    The tip frame has its origin in the pad's face, z back along the tool. One step is 1/30 s. There is this
    single-environment face only; run several with ``gymnasium.vector.AsyncVectorEnv`` or ``SyncVectorEnv``.

    ## Action space

    A ``Box(-1, 1, (6,), float32)``; values beyond are clipped, values that are not finite raise
    ``ActionError``.

    | control | meaning of 1 |
    | --- | --- |
    | ``"tip"`` (default) | tip acceleration, d/dt of the body twist: 1 m/s^2, 25 rad/s^2 |
    | ``"joint"`` | joint acceleration, 15 rad/s^2 |

    ## Observation space

    ``observation="features"``: a ``Box`` of 57 float32, clipped to +-max:

    | index | name | unit | max |
    | --- | --- | --- | --- |
    | 0-23 | where to press, 8 places: from the tip, in the tip frame; 0 if there are fewer | mm | 2000 |
    | 24-31 | whether each place is still open | 0 or 1 | 1 |
    | 32-34 | tip velocity | mm/s | 5000 |
    | 35-37 | tip angular velocity | deg/s | 2000 |
    | 38-40 | tip acceleration commanded a frame ago | m/s^2 | 50 |
    | 41-43 | angular acceleration commanded a frame ago | rad/s^2 | 500 |
    | 44 | largest force of the pad on a tie in the frame | N | 1000 |
    | 45-50 | joint angles | rad | 10 |
    | 51-56 | joint speeds | rad/s | 10 |

    With ``perception="vision"`` the places are those where the observer saw targets in the picture taken at
    the start, with ``"oracle"`` the middles of the open ties' tops. A press that brings a tie home closes the
    open place nearest to the pad, if it is within 20 mm.

    ``observation="features+images"``: a ``Dict`` with ``features`` as above and the picture that the RGB-D
    camera took at the start, the tool out of its view: ``rgb`` (480, 400, 3) uint8 and ``depth_m``
    (480, 400) float32, 0 where there is none.

    ## Reward

    See ``seal_gym.tasks.pressing``: +10 for a tie pressed home, +20 for the last, 2 for each 100 mm nearer to
    the next open tie, -5 for a wrong touch, -20 for a protective stop, small penalties for time and for jumps
    of the action.

    ## Episode end

    ``terminated``: *reached* (all ties home), *collision* (150 N or more on anything: the arm's protective
    stop). ``truncated``: *timeout* (10 s and 8 s a tie). A wrong touch does not end an episode: it counts.
    Steps after the end without a ``reset`` earn nothing and keep the outcome.

    ## Info

    ``progress`` (share of the ties that are home), ``targets``, ``targets_done``, ``wrong_touches`` (so far),
    ``touched`` (classes touched by mistake now), ``force_n``, ``collision``, ``reached``, ``is_success``
    (reached without a wrong touch); at an episode's end ``episode_metrics``: ``outcome``, ``reached``,
    ``collision``, ``timeout``, ``targets``, ``targets_done``, ``wrong_touches``, ``wrong_<class>``,
    ``path_mm``, ``peak_jerk_m_s3`` (of the commanded tip), ``peak_force_n``, ``time_s``.

    ## Arguments

    See ``PaletteCfg`` for the keyword arguments; ``render_mode``: ``None`` or ``"rgb_array"`` (720 x 1280).

    ## Version history

    v0: first version.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012  # as gymnasium.Env declares it

    def __init__(self, *, render_mode: str | None = None, **kwargs: Any) -> None:
        """Takes the arguments; the first cell is built by ``reset``.

        Args:
            render_mode: See above.
            **kwargs: Attributes of ``PaletteCfg``.

        Raises:
            ConfigError: If an argument is unknown or out of range.
        """
        EzPickle.__init__(self, render_mode=render_mode, **kwargs)
        check_render_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.cfg = PaletteCfg.of(**kwargs)
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.observation_space = self._space()
        direct = TipAdapter if self.cfg.control == "tip" else JointAdapter
        self._adapter: TipAdapter | JointAdapter = direct(self.cfg.cell)
        self._look = Look.empty(1)
        self._picture: Picture | None = None
        self._renderer: mujoco.Renderer | None = None
        self._running = False
        self._final: Events | None = None

    def _space(self) -> spaces.Space[Any]:
        features = spaces.Box(_LOWER.astype(np.float32), _BOUND.astype(np.float32), dtype=np.float32)
        if self.cfg.observation == "features":
            return features
        width, height = self.cfg.camera.frame_px
        return spaces.Dict(
            {
                "features": features,
                "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
                "depth_m": spaces.Box(0.0, self.cfg.depth_noise.range_m + 1.0, (height, width), np.float32),
            }
        )

    # -- running ----------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Lays out a new palette.

        Args:
            seed: Seeds ``np_random``; without one the generator goes on.
            options: None are defined.

        Returns:
            Observation and info.

        Raises:
            ConfigError: If an option is given.
        """
        super().reset(seed=seed)
        if options:
            raise ConfigError(f"options = {options!r}: reset takes none in this version")
        cfg, rng, place = self.cfg, self.np_random, self.cfg.placement
        self._close_renderer()
        self.scene: PaletteScene = build_palette(draw_layout(rng, cfg.layout), cfg.cell)
        self.arm = ArmBatch(self.scene, 1, record=("sensordata",))
        shift, yaw = rng.uniform(-place.shift_m, place.shift_m, 2), rng.uniform(-place.yaw_rad, place.yaw_rad)
        self.part_pose = yaw_pose(place.palette_x_m + shift[0], shift[1], BOARD_TOP_M, yaw)
        self._start(rng)
        self._look.draw(0, rng, cfg.look)
        self._noise = np.random.default_rng(self._look.seed[0])
        self.tip = tip_kinematics(self.arm.q, self.arm.qd)
        points = self.scene.layout.target_m
        self.target_m: Array = points @ self.part_pose[:3, :3].T + self.part_pose[:3, 3]
        self.pressing = Pressing(
            self.target_m, self.tip.pose[0, :3, 3], len(WRONG), cfg.cell.timing.frame_s, cfg.task
        )
        self._tip_accel, self._action = np.zeros(6), np.zeros(6)
        sees = cfg.perception == "vision" or cfg.observation == "features+images"
        self._picture = self.look() if sees else None
        self.place_m = self._places()
        self.place_open = np.ones(len(self.place_m), np.bool_)
        self._running, self._final = True, None
        return self._observe(), self._info(None)

    def _start(self, rng: np.random.Generator) -> None:
        """Puts the tool beside the palette where it touches nothing."""
        place = self.cfg.placement
        for _ in range(_MAX_DRAWS):
            spread = rng.uniform(-1.0, 1.0, 3) * place.spread_m
            pose = transform(np.eye(3), np.array(place.home_m) + spread)
            q = ik.nearest(ik.solve(pose), POSTURE)
            if np.isnan(q).any():
                continue
            self.arm.reset(0, q, self.part_pose)
            if not self.arm.contacts(0):
                return
        raise ConfigError(
            f"no start in {_MAX_DRAWS} draws is free of contact and within reach: change PlacementCfg.home_m "
            f"= {place.home_m} or spread_m = {place.spread_m}"
        )

    def _places(self) -> Array:
        """Where the observation says to press, shape (n, 3), m, n <= 8."""
        if self.cfg.perception == "oracle":
            return self.target_m
        assert self._picture is not None
        places = targets_of(self.cfg.observer(self._picture.rgb, self._picture.depth_m, self.cfg.camera))
        return places[:MAX_TARGETS]

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advances one frame.

        Args:
            action: Shape (6,), see the class.

        Returns:
            Observation, reward, terminated, truncated, info.

        Raises:
            ActionError: If the action has a wrong shape or is not finite.
            ResetNeeded: If called before ``reset``.
        """
        if not self._running:
            raise gym.error.ResetNeeded("call reset() before step()")
        move = self._checked(action)
        command = tip_kinematics(self.arm.q_command, self.arm.qd_command)
        qdd = self._adapter(move[None], _Command(command))
        self.arm.step(qdd)
        self._tip_accel = (command.jacobian @ qdd[:, :, None])[0, :, 0] + command.drift[0]
        self.tip = tip_kinematics(self.arm.q, self.arm.qd)
        events = self._final if self._final is not None else self._score()
        change = 0.5 * float(np.abs(move - self._action).mean())
        self._action = move
        earned = reward(events, change, self.cfg.reward) if self._final is None else 0.0
        terminated = events.completed or events.stopped
        if terminated or events.timeout:
            self._final = events
        return self._observe(), earned, terminated, events.timeout, self._info(events)

    def _checked(self, action: Any) -> Array:
        move = as_action(action, (6,), self.cfg.control)
        if not np.isfinite(move).all():
            bad = int(np.argmax(~np.isfinite(move)))
            raise ActionError(
                f"action[{bad}] = {move[bad]}: must be finite; values beyond [-1, 1] are clipped"
            )
        return np.clip(move, -1.0, 1.0)

    def _score(self) -> Events:
        """Reads the contacts; ties that came home lock."""
        recorded = self.arm.recorded
        touches = read_touches(self.scene, recorded["ncon"][0], recorded["sensordata"][0])
        command = tip_kinematics(self.arm.q_command, self.arm.qd_command)
        events = self.pressing.advance(
            touches.press_n,
            touches.slide_m,
            touches.wrong,
            touches.wrong_n,
            self.tip.pose[0, :3, 3],
            command.pose[0, :3, 3],
        )
        for k in np.flatnonzero(events.home):
            self.arm.hold(0, int(k))
        if events.home.any() and self.place_open.any():
            away = np.linalg.norm(self.place_m - self.tip.pose[0, :3, 3], axis=1)
            away[~self.place_open] = np.inf
            self.place_open[np.argmin(away)] = away.min() > _AT_TARGET_M
        return events

    # -- what is told -----------------------------------------------------------------------------------

    def _observe(self) -> Any:
        pose, n = self.tip.pose[0], len(self.place_m)
        places, still_open = np.zeros((MAX_TARGETS, 3)), np.zeros(MAX_TARGETS)
        places[:n] = (self.place_m - pose[:3, 3]) @ pose[:3, :3]
        still_open[:n] = self.place_open
        rows = np.concatenate(
            (
                places.ravel(),
                still_open,
                self.tip.twist[0],
                self._tip_accel,
                [self.pressing.force_n],
                self.arm.q[0],
                self.arm.qd[0],
            )
        )
        features = np.clip(_SCALE * rows, _LOWER, _BOUND).astype(np.float32)
        if self.cfg.observation == "features":
            return features
        assert self._picture is not None
        depth = np.nan_to_num(self._picture.depth_m, nan=0.0)
        return {"features": features, "rgb": self._picture.rgb.copy(), "depth_m": np.maximum(depth, 0.0)}

    def _info(self, events: Events | None) -> dict[str, Any]:
        score = self.pressing
        reached = events is not None and events.completed
        collision = events is not None and events.stopped
        info: dict[str, Any] = {
            "progress": float(score.home.mean()),
            "targets": len(score.home),
            "targets_done": int(score.home.sum()),
            "wrong_touches": int(score.wrong.sum()),
            "touched": [name for name, now in zip(WRONG, score.touched, strict=True) if now],
            "force_n": score.force_n,
            "collision": collision,
            "reached": reached,
            "is_success": reached and not score.wrong.any(),
        }
        if events is not None and (reached or collision or events.timeout):
            outcome = "reached" if reached else "collision" if collision else "timeout"
            wrong = {f"wrong_{name}": int(n) for name, n in zip(WRONG, score.wrong, strict=True)}
            info["episode_metrics"] = {
                "outcome": outcome,
                "reached": reached,
                "collision": collision,
                "timeout": outcome == "timeout",
                **score.metrics(),
                **wrong,
            }
        return info

    def look(self) -> Picture:
        """Takes a picture from above now, arm and all.

        Returns:
            With the sensor's errors.
        """
        camera = RgbdCamera(self.scene.model, self.cfg.camera)
        ideal = camera.ideal(self.arm.data(0), self._look)
        return camera.sense(ideal, self._look, self.cfg.depth_noise, self._noise)

    @property
    def picture(self) -> Picture:
        """The picture taken at the start; with ``perception="oracle"`` and no images there is none.

        Raises:
            ConfigError: If there is none.
        """
        if self._picture is None:
            raise ConfigError(
                "no picture was taken: use perception='vision' or observation='features+images', or look()"
            )
        return self._picture

    # -- pictures ---------------------------------------------------------------------------------------

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]  # gymnasium types it as RenderFrame
        """A picture of the cell from the side.

        Returns:
            Shape (720, 1280, 3) with ``render_mode="rgb_array"``.

        Raises:
            RenderError: If this machine cannot make pictures.
            ResetNeeded: If called before ``reset``.
        """
        if self.render_mode is None:
            gym.logger.warn('render() without render_mode: pass render_mode="rgb_array" to gym.make')
            return None
        if not self._running:
            raise gym.error.ResetNeeded("call reset() before render()")
        from seal_gym.sim.gl import offscreen  # loads OpenGL: only for pictures

        if self._renderer is None:
            self._renderer = offscreen(self.scene.model, HEIGHT, WIDTH)
        option, camera = mujoco.MjvOption(), mujoco.MjvCamera()
        option.geomgroup[GROUP_COLLISION] = 0
        camera.lookat[:] = self.part_pose[:3, 3] + [-0.03, -0.02, 0.07]
        camera.distance, camera.azimuth, camera.elevation = 0.85, 150.0, -34.0
        self._renderer.update_scene(self.arm.data(0), camera=camera, scene_option=option)
        return np.asarray(self._renderer.render())

    def close(self) -> None:
        """Closes contexts; safe to call twice."""
        self._close_renderer()

    def _close_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
