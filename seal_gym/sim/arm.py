"""N arms over N parts, stepped together: joint accelerations in, joint states and contacts out."""

from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from seal_gym.core.cell import CellCfg
from seal_gym.core.errors import PhysicsError
from seal_gym.core.frames import Array, quat_from_matrix
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_SPEED, JOINT_TORQUE, JOINT_UPPER

_CTRL = int(mujoco.mjtState.mjSTATE_CTRL)
_OUTSIDE = int(
    mujoco.mjtState.mjSTATE_CTRL
    | mujoco.mjtState.mjSTATE_XFRC_APPLIED
    | mujoco.mjtState.mjSTATE_MOCAP_POS
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)


class ArmScene(Protocol):
    """A compiled cell with the arm in it: its joints come first, and the part is the first mocap body."""

    @property
    def model(self) -> mujoco.MjModel:
        """The MuJoCo model."""

    @property
    def cell(self) -> CellCfg:
        """The cell it was built for."""


class Poses(NamedTuple):
    """Poses of N bodies at K instants.

    Attributes:
        position: Shape (N, K, 3), m.
        quat: Shape (N, K, 4), (w, x, y, z).
    """

    position: Array
    quat: Array


class Outside(NamedTuple):
    """What moves and pushes in N cells during a frame of S physics steps; None where nothing does.

    A step sees the bodies where they are when it starts, like the arm. MuJoCo knows no velocity of bodies
    that are moved from outside; the first contact ends an episode, so that none of its forces matters.

    Attributes:
        part: Poses of the parts at the steps' starts and the frame's end, K = S + 1.
        part_pose: ``T_base_part`` at the frame's end, shape (N, 4, 4), m.
        obstacle: Centres of the obstacles at the same instants, shape (N, S + 1, 3), m.
        force: On a body's centre of mass during each step, in the base frame, shape (N, S, 3), N.
        pushed: Name of that body.
    """

    part: Poses | None = None
    part_pose: Array | None = None
    obstacle: Array | None = None
    force: Array | None = None
    pushed: str = ""


class ArmBatch:
    """The physics of N cells of one scene.

    A commanded joint trajectory is integrated from the accelerations within the UR5's speed and position
    limits; gravity-compensated position servos (``assets/ur5_sealgun/ur5.xml``) follow it within the real
    torque limits. The servo's target leads the trajectory by (kv / kp) qd, which cancels the lag of its
    damping. Where the torque does not suffice the trajectory waits for the arm.

    Attributes:
        q: Joint angles, shape (N, 6), rad; a live view of the simulation.
        qd: Joint speeds, shape (N, 6), rad/s; a live view of the simulation.
        q_command: Commanded joint angles, shape (N, 6), rad.
        qd_command: Commanded joint speeds, shape (N, 6), rad/s.
        part_pose: ``T_base_part``, shape (N, 4, 4), m.
        recorded: What was asked to be recorded, after each physics step of the last frame, by its name in
            ``MjData``, each of shape (N, S, ...).
    """

    def __init__(self, scene: ArmScene, n: int, threads: int = 0, record: tuple[str, ...] = ()) -> None:
        """Allocates N simulations.

        Args:
            scene: The compiled scene.
            n: Number of simulations, >= 1.
            threads: Threads to step them on, the caller's included; 0 and 1 mean the caller's alone.
            record: Fields of ``MjData`` to record besides the number of contacts.
        """
        model = scene.model
        self.scene = scene
        self.n = n
        self._batch = Batch(model, n, nthread=max(threads, 0))
        self.q: Array = self._batch.bind("qpos")[:, :6]
        self.qd: Array = self._batch.bind("qvel")[:, :6]
        self._mocap_pos: Array = self._batch.bind("mocap_pos")
        self._mocap_quat: Array = self._batch.bind("mocap_quat")
        self._force: Array = self._batch.bind("xfrc_applied")
        self.q_command = np.zeros((n, 6))
        self.qd_command = np.zeros((n, 6))
        self.part_pose = np.tile(np.eye(4), (n, 1, 1))
        steps = scene.cell.timing.substeps
        self._dt = scene.cell.timing.frame_s
        # An implicit step sees the position it starts from and the speed it ends with.
        ends = np.arange(1, steps + 1) * scene.cell.timing.step_s
        self._t_end = ends[None, :, None]
        self._t_start = self._t_end - scene.cell.timing.step_s
        kp, kv = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
        self._lead = kv / kp
        # Leads at which position and speed servo alone ask for all the torque there is: more is windup.
        self._pull_q, self._pull_qd = JOINT_TORQUE / kp, JOINT_TORQUE / kv
        self._contact = {"ncon": np.zeros((n, steps), np.int32)}
        self._record = ("ncon", *record)
        self.recorded: dict[Any, NDArray[Any]] = {}

    def reset(self, i: int, q: Array, part_pose: Array) -> None:
        """Puts one simulation at rest.

        Args:
            i: Which simulation.
            q: Joint angles, shape (6,), rad.
            part_pose: ``T_base_part``, shape (4, 4), m.
        """
        self._batch.reset([i], stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self.q[i] = self.q_command[i] = q
        self.qd[i] = self.qd_command[i] = 0.0
        self.place_part(i, part_pose)

    def place_part(self, i: int, part_pose: Array) -> None:
        """Moves the part of one simulation.

        Args:
            i: Which simulation.
            part_pose: ``T_base_part``, shape (4, 4), m.
        """
        self.part_pose[i] = part_pose
        self._mocap_pos[i, 0] = part_pose[:3, 3]
        self._mocap_quat[i, 0] = quat_from_matrix(part_pose[:3, :3])

    def step(self, qdd: Array, outside: Outside | None = None) -> NDArray[np.bool_]:
        """Advances all simulations by one frame.

        Args:
            qdd: Commanded joint accelerations, shape (N, 6), rad/s^2.
            outside: What moves and pushes meanwhile; by default nothing.

        Returns:
            Whether anything touched anything during the frame, shape (N,).

        Raises:
            PhysicsError: If MuJoCo reports an error.
        """
        dt = self._dt
        q = np.minimum(np.maximum(self.q_command, self.q - self._pull_q), self.q + self._pull_q)
        qd = np.minimum(np.maximum(self.qd_command, self.qd - self._pull_qd), self.qd + self._pull_qd)
        speed = np.minimum(np.maximum(qd + qdd * dt, -JOINT_SPEED), JOINT_SPEED)
        reached = q + 0.5 * (qd + speed) * dt
        stopped = (reached < JOINT_LOWER) | (reached > JOINT_UPPER)
        if stopped.any():
            reached = np.clip(reached, JOINT_LOWER, JOINT_UPPER)
            speed = np.where(stopped, 0.0, speed)
        acceleration = (speed - qd) / dt
        start, rate = q[:, None], qd[:, None]
        t, a = self._t_start, acceleration[:, None]
        target = start + t * (rate + 0.5 * t * a) + self._lead * (rate + self._t_end * a)
        inputs, spec = (target, _CTRL) if outside is None else (self._inputs(target, outside), _OUTSIDE)
        try:
            self.recorded = self._batch.rollout(
                target.shape[1], inputs, spec, record=self._record, out=self._contact
            )
        except SimulationError as error:
            raise PhysicsError(f"MuJoCo stopped simulations {error.ids.tolist()}: {error}") from error
        if outside is not None:
            self._arrive(outside)
        self.q_command, self.qd_command = reached, speed
        return np.asarray(self.recorded["ncon"].any(axis=1))

    def _inputs(self, target: Array, outside: Outside) -> Array:
        """Servo targets, forces and poses of each physics step, in the order of ``mjtState``'s bits."""
        n, steps, _ = target.shape
        model = self.scene.model
        force = np.zeros((n, steps, model.nbody, 6))
        position = np.repeat(self._mocap_pos[:, None], steps, axis=1)
        quat = np.repeat(self._mocap_quat[:, None], steps, axis=1)
        if outside.force is not None:
            force[:, :, model.body(outside.pushed).id, :3] = outside.force
        if outside.part is not None:
            position[:, :, 0], quat[:, :, 0] = outside.part.position[:, :-1], outside.part.quat[:, :-1]
        if outside.obstacle is not None:
            position[:, :, 1] = outside.obstacle[:, :-1]
        return np.concatenate((target, *(x.reshape(n, steps, -1) for x in (force, position, quat))), axis=2)

    def _arrive(self, outside: Outside) -> None:
        """Puts part and obstacle where they are at the frame's end, as the arm already is; nothing pushes."""
        self._force[:] = 0.0
        if outside.part is not None and outside.part_pose is not None:
            self._mocap_pos[:, 0], self._mocap_quat[:, 0] = (x[:, -1] for x in outside.part)
            self.part_pose[:] = outside.part_pose
        if outside.obstacle is not None:
            self._mocap_pos[:, 1] = outside.obstacle[:, -1]

    def place_obstacle(self, i: int, position: Array) -> None:
        """Puts the obstacle of one simulation somewhere; the scene must have one.

        Args:
            i: Which simulation.
            position: Of its centre in the base frame, shape (3,), m.
        """
        self._mocap_pos[i, 1] = position

    def hold(self, i: int, constraint: int) -> None:
        """Switches an equality constraint of one simulation on.

        Args:
            i: Which simulation.
            constraint: Its number in the model.
        """
        self._batch.bind("eq_active")[i, constraint] = 1.0

    def data(self, i: int) -> mujoco.MjData:
        """One simulation's state as an ``MjData``, to render it or to look into it.

        Args:
            i: Which simulation.

        Returns:
            A copy with positions, contacts and cameras up to date.
        """
        data = self._batch.get_data(i)
        mujoco.mj_forward(self.scene.model, data)
        return data

    def contacts(self, i: int) -> list[tuple[str, str]]:
        """Names of the geoms that touch in one simulation now.

        Args:
            i: Which simulation.

        Returns:
            Pairs of geom names.
        """
        model = self.scene.model
        return [(model.geom(int(c.geom1)).name, model.geom(int(c.geom2)).name) for c in self.data(i).contact]
