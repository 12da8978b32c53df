"""``SealEnv``: the single-environment face of the sealing core."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from seal_gym.envs.adapters import LeafFunction
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import Observation, SealCore, StepResult, as_action
from seal_gym.envs.journey import check_start
from seal_gym.envs.viewing import SceneView, check_render_mode


def first(observation: Observation) -> Any:
    """The only row of an observation of one simulation.

    Args:
        observation: Of N = 1.

    Returns:
        The same without its leading dimension.
    """
    if isinstance(observation, dict):
        return {name: rows[0] for name, rows in observation.items()}
    return observation[0]


class SealEnv(gym.Env[Any, NDArray[np.float32]], EzPickle):
    """A UR5 seals a workpiece with a pneumatic gun, seen through two small regions of interest.

    ## Description

    The gun starts in a hover at the seam's start, beyond the stand-off of 3 mm, displaced and turned; the
    part lies somewhere within +-20 mm and +-15 deg of its nominal pose. The task is to bring the nozzle to
    the stand-off and to follow the seam at 10 mm/s to its end. Source: Zhou et al., "Neural reactive path
    planning with Riemannian motion policies for robotic sealing", sections 2 and 4; geometry, outcomes and
    metrics as in the benchmark protocol (docs in README.md).

    ``reset(options={"start": "home"})`` begins with the arm at rest (``kinematics.HOME_Q``) above the table,
    the same hover ahead: the info's ``hover_pose`` says where. Until the gun has been there (3 mm, 3 deg)
    neither view is valid, no error counts and the sealant's valve stays shut; the time limit is 10 s longer.

    The tip frame has its origin at the nozzle mouth, x to the right of travel, y along travel, z back along
    the nozzle. One step is one camera frame, 1/30 s.

    ## Action space

    A ``Box(-1, 1, (n,), float32)``; values beyond are clipped, values that are not finite raise
    ``ActionError``.

    | control | n | meaning of 1 |
    | --- | --- | --- |
    | ``"tip"`` (default) | 6 | tip acceleration, d/dt of the body twist: 1 m/s^2, 25 rad/s^2 |
    | ``"rmp"`` | 27 | 6 f as above, then the 21 entries of A's lower Cholesky factor by rows, times 2 |
    | ``"joint"`` | 6 | joint acceleration, 15 rad/s^2 |

    With ``"rmp"`` the policy's leaf is resolved with fixed leaves: damping against the reference twist,
    regularisation, lean, joint limits, and any leaf passed as ``leaves`` or added with ``add_leaf``.

    With ``sealant`` one more entry, the last: the gun's pressure, -1 none, 1 ``GunCfg.pressure_max_pa`` (150
    kPa), which the nozzle sees behind a first-order lag of 80 ms.

    ## Observation space

    ``observation="features"``: a ``Box`` of 35 float32, clipped to +-max:

    | index | name | unit | max |
    | --- | --- | --- | --- |
    | 0 | attraction distance, front view: x of the seam in the tip frame | mm | 100 |
    | 1 | seam angle, front view: atan2(dx, dy) of its direction | deg | 180 |
    | 2 | front view valid | 0 or 1 | 1 |
    | 3 | attraction distance, side view: z of the seam above one stand-off before the mouth | mm | 100 |
    | 4 | seam angle, side view: atan2(dz, dy) | deg | 180 |
    | 5 | side view valid | 0 or 1 | 1 |
    | 6-7 | estimated velocity of the seam across itself, x and z | mm/s | 1000 |
    | 8-9 | estimated turning of the seam under the tip, about x and z | deg/s | 1000 |
    | 10 | lean: rotation about y that restores the taught one | deg | 180 |
    | 11-13 | tip velocity | mm/s | 5000 |
    | 14-16 | tip angular velocity | deg/s | 2000 |
    | 17-19 | tip acceleration commanded a frame ago | m/s^2 | 50 |
    | 20-22 | angular acceleration commanded a frame ago | rad/s^2 | 500 |
    | 23-28 | joint angles | rad | 10 |
    | 29-34 | joint speeds | rad/s | 10 |

    With ``sealant`` three more entries:

    | index | name | unit | max |
    | --- | --- | --- | --- |
    | 35 | pressure at the nozzle | kPa | 2000 |
    | 36 | width of the bead 3.6-5.2 mm behind the nozzle, in the side view | mm | 50 |
    | 37 | bead seen | 0 or 1 | 1 |

    ``observation="features+images"``: a ``Dict`` with ``features`` as above and the ROIs ``front``
    (100, 50, 3) and ``side`` (50, 100, 3), uint8 RGB.

    ## Reward

    See ``seal_gym.tasks.reward``: new ground along the seam in nominal steps (at most 1) times the tracking
    quality 1 / (1 + (e / 1 mm)^2), a potential of the tip error, small penalties for heading error and for
    jumps of the action, +20 for a sealed seam and -20 for a collision or a lost seam. Bounded by +-23.15.
    ``SealantCfg(reward=w)`` takes off w times the relative error of the bead's section behind the tip, at
    most w a step.

    ## Episode end

    ``terminated``: *reached* (past the end within 5 mm, 95 % of the seam visited within 5 mm), *collision*
    (the first contact of gun, arm or cameras with part, table or each other), *lost* (25 mm off the path).
    ``truncated``: *timeout* (3x the nominal time). Steps after the end without a ``reset`` earn nothing.

    ## Info

    ``tip_error_mm``, ``progress`` (0..1), ``collision``, ``reached``, ``is_success``, ``renderer``,
    ``seam_velocity`` (estimated twist of the seam in the tip frame, m/s and rad/s), ``roi`` (the features by
    name with validity, in mm, rad and px), ``snr_db`` with images; ``disturbances`` as the keyword argument
    takes them again, and ``obstacle`` (``position_m``, ``velocity_m_s``, ``radius_m``), where there are any;
    at an episode's end ``episode_metrics``: ``outcome``, ``reached``, ``collision``, ``timeout`` (lost
    included), ``rmse_mm`` (None before 10 mm of travel), ``rmse_whole_mm``, ``coverage_pct``, ``time_s``,
    and on moving parts ``seam_speed_mm_s``. Errors are those against the seam where it is at that instant.
    Started at home also ``under_way``, ``hover_pose`` (``T_base_tip``, m) and, in the metrics, ``journey_s``.
    With sealant ``sealant`` (``Extrusion.info``), and in ``episode_metrics`` the bead's (``Bead.metrics``).

    ## Arguments

    See ``SealCfg`` for the keyword arguments; ``render_mode``: ``None``, ``"rgb_array"`` (third-person view
    with the ROIs as insets, 720 x 1280) or ``"human"`` (MuJoCo's viewer).

    ## Version history

    v0: first version.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 30}  # noqa: RUF012  # as gymnasium.Env declares it

    def __init__(self, *, render_mode: str | None = None, **kwargs: Any) -> None:
        """Builds the cell.

        Args:
            render_mode: See above.
            **kwargs: Attributes of ``SealCfg``.

        Raises:
            ConfigError: If an argument is unknown or out of range.
            SeamError: If this cell cannot seal the workpiece.
        """
        EzPickle.__init__(self, render_mode=render_mode, **kwargs)
        check_render_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.core = SealCore(SealCfg.of(**kwargs), 1)
        self.action_space = self.core.action_space
        self.observation_space = self.core.observation_space
        self._view = SceneView(self.core) if render_mode else None
        self._running = self._ended = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seeds ``np_random``; without one the generator goes on.
            options: ``{"start": "home"}`` begins at the arm's posture of rest instead of the hover, which
                ``info["hover_pose"]`` then names.

        Returns:
            Observation and info.

        Raises:
            ConfigError: If there is no such option or start, or the part is in the posture of rest's way.
        """
        super().reset(seed=seed)
        self.core.reset(0, self.np_random, check_start(options))
        observation = first(self.core.observe())
        self._running, self._ended = True, False
        self._show()
        return observation, self.core.info(0, None)

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advances one camera frame.

        Args:
            action: Shape (n,), see the class.

        Returns:
            Observation, reward, terminated, truncated, info.

        Raises:
            ActionError: If the action has a wrong shape or is not finite.
            ResetNeeded: If called before ``reset``.
        """
        if not self._running:
            raise gym.error.ResetNeeded("call reset() before step()")
        core = self.core
        result: StepResult = core.step(as_action(action, (core.action_size,), core.cfg.control)[None])
        ended, self._ended = self._ended, self._ended or bool(result.terminated[0] or result.timeout[0])
        observation = first(core.observe())
        self._show()
        return (
            observation,
            0.0 if ended else float(result.reward[0]),
            bool(result.terminated[0]),
            bool(result.timeout[0]),
            core.info(0, result),
        )

    def disturb(self, disturbance: object) -> None:
        """Adds a disturbance; a ``reset`` has to follow. What ``seal_gym.wrappers`` call.

        Args:
            disturbance: As ``SealCfg.disturbances`` takes them.

        Raises:
            ConfigError: If it is wrong, or there is one of its kind.
        """
        self.core = self.core.disturbed(disturbance)
        self._ezpickle_kwargs["disturbances"] = self.core.cfg.disturbances
        self._running = self._ended = False
        if self._view is not None:
            self._view.close()
            self._view = SceneView(self.core)

    def add_leaf(self, leaf: LeafFunction) -> None:
        """Adds an RMP leaf at run time; needs ``control="rmp"``.

        Args:
            leaf: Gives a ``Leaf`` from an ``ArmState``.
        """
        self.core.add_leaf(leaf)

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]  # gymnasium types it as RenderFrame
        """A picture of the cell with the ROIs as insets, or nothing with the viewer.

        Returns:
            Shape (720, 1280, 3) with ``render_mode="rgb_array"``.

        Raises:
            RenderError: If this machine cannot make pictures.
        """
        if self._view is None:
            gym.logger.warn('render() without render_mode: pass render_mode="rgb_array" to gym.make')
            return None
        if self.render_mode == "human":
            self._view.sync()
            return None
        return self._view.picture()

    def close(self) -> None:
        """Closes windows and contexts; safe to call twice."""
        if self._view is not None:
            self._view.close()

    def _show(self) -> None:
        if self.render_mode == "human" and self._view is not None:
            self._view.sync()
