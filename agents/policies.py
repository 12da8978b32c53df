"""Policies that learn: neural RMP, its ablation with A = I, and direct control; their files.

All kinds share everything but the last layer: an extractor for each group of inputs, a regressor on the
extracted features, and a linear path from the inputs to the accelerations. Zhou et al., 2.3 and 4.2. The
solver stays outside the network, in the environment's ``rmp`` adapter with its fixed leaves.

Inputs (``group_inputs``). From the 35 entries of an observation, in physical scales and not in statistics of
the training data, so that a part with sharper corners meets the same numbers:

| group | entries | scale |
| --- | --- | --- |
| front view | distance, angle | 2 mm, 5 deg |
| side view | distance, angle | 2 mm, 5 deg |
| motion | tip twist less the seam's twist and, along y, less the nominal speed | 10 mm/s, 20 deg/s |
| lean | rotation about y that restores it | 5 deg |

Left out are the joints' angles and speeds, which say where the part stands and not where the seam goes, and
the last acceleration, which a clone learns to repeat (de Haan et al. 2019, "Causal Confusion in Imitation
Learning"). The seam's twist enters only in the difference: on parts that stand still it is noise, from which
no network learns that it must cancel the tip's own; with the difference, moving parts need no training.

Outside the training range the extractors saturate (tanh), as the expert's springs and metrics do, and the
linear path goes on, as the expert's damping does.

A view that is lost is never in the demonstrations, so no network can learn what to do then, and the features
are old: the policies of every kind brake until both views are back (``_brake``).
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load as read_tensors
from safetensors.torch import save as write_tensors
from torch import Tensor, nn

from agents.reading import Reading, read, rows_of
from seal_gym.core.cell import CellCfg, load_cell
from seal_gym.core.errors import ConfigError, SealGymError, is_number, require
from seal_gym.core.frames import Array
from seal_gym.envs.adapters import CHOLESKY_SCALE
from seal_gym.envs.core import FEATURES
from seal_gym.rmp import DampingCfg

ACCELS = 6
CHOLESKY = 21
GROUPS = {"front": 2, "side": 2, "motion": 6, "lean": 1}
CONTROL_OF = {"neural_rmp": "rmp", "neural_rmp_identity": "rmp", "neural_control": "tip"}
KINDS = tuple(CONTROL_OF)
FORMAT, VERSION = "seal_gym policy", 1

_MM = 1e-3
_DISTANCE_MM, _ANGLE_DEG = 2.0, 5.0  # about the errors at which the expert's springs saturate
_SPEED_MM_S, _TURN_DEG_S = 10.0, 20.0
# Smallest diagonal entry of the Cholesky factor, as an action: a metric of 4e-4 beside the expert's 0.5 to 1,
# and beside the 0.1 of the fixed leaf on the lean, of which the expert says nothing.
_SMALLEST_DIAGONAL = 0.01
_DIAGONAL = tuple(k * (k + 3) // 2 for k in range(ACCELS))  # of L00, L11, ... among the 21, row by row
_ON_DIAGONAL = torch.tensor([k in _DIAGONAL for k in range(CHOLESKY)])
_UNIT_METRIC = 1.0 / CHOLESKY_SCALE  # the action's diagonal entry for A = I
_BRAKE_S = 12.0  # as fast as the expert holds its speed [1/s]
_LONGEST_FILE = 64 * 2**20


def _input_matrix() -> Tensor:
    """From an observation and the nominal speed [mm/s] to the inputs, as the module's table says."""
    matrix = torch.zeros(FEATURES + 1, sum(GROUPS.values()))
    distance, angle, speed, turn = 1 / _DISTANCE_MM, 1 / _ANGLE_DEG, 1 / _SPEED_MM_S, 1 / _TURN_DEG_S
    for column, (row, factor) in enumerate(((0, distance), (1, angle), (3, distance), (4, angle))):
        matrix[row, column] = factor
    seam_rows = (6, FEATURES, 7, 8, None, 9)  # what each entry of the tip's twist is measured against
    for axis, (seam, factor) in enumerate(zip(seam_rows, [speed] * 3 + [turn] * 3, strict=True)):
        matrix[11 + axis, 4 + axis] = factor
        if seam is not None:
            matrix[seam, 4 + axis] = -factor
    matrix[10, -1] = angle
    return matrix


_INPUTS = _input_matrix()


class PolicyFileError(SealGymError, ValueError):
    """A file holds no policy of ours, or a damaged one."""


@dataclass(frozen=True, kw_only=True)
class PolicyCfg:
    """What a learned policy is, besides its weights.

    Attributes:
        kind: One of ``KINDS``.
        extracted: Features that each extractor gives.
        hidden: Width of the regressor's two layers.
        speed_m_s: Nominal speed along the seam [m/s].
        linear_m_s2: What an action of 1 means [m/s^2].
        angular_rad_s2: What an action of 1 means [rad/s^2].
    """

    kind: str
    extracted: int = 16
    hidden: int = 64
    speed_m_s: float = 0.010
    linear_m_s2: float = 1.0
    angular_rad_s2: float = 25.0

    def __post_init__(self) -> None:
        """Checks the choices."""
        require(self.kind in KINDS, f"kind = {self.kind!r}: must be one of {list(KINDS)}")
        for name in ("extracted", "hidden"):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            require(
                whole and 1 <= value <= 1024,
                f"PolicyCfg.{name} = {value!r}: must be a whole number in 1..1024",
            )
        for name in ("speed_m_s", "linear_m_s2", "angular_rad_s2"):
            value = getattr(self, name)
            require(
                is_number(value) and value > 0, f"PolicyCfg.{name} = {value!r}: must be a finite number > 0"
            )

    @classmethod
    def of(cls, kind: str, cell: CellCfg | None = None) -> "PolicyCfg":
        """The configuration of a kind for a cell; kinds have the same number of parameters within 5 %.

        Args:
            kind: One of ``KINDS``.
            cell: Speed and limits.

        Returns:
            The configuration.
        """
        cell = cell or load_cell()
        # A last layer of 6 rather than 27 outputs leaves parameters over for a wider regressor.
        return cls(
            kind=kind,
            hidden=64 if kind == "neural_rmp" else 70,
            speed_m_s=cell.process.speed_m_s,
            linear_m_s2=cell.limits.linear_m_s2,
            angular_rad_s2=cell.limits.angular_rad_s2,
        )

    @property
    def control(self) -> str:
        """The ``control`` its environment needs."""
        return CONTROL_OF[self.kind]

    @property
    def scale(self) -> Array:
        """Acceleration that an action of 1 means, shape (6,), m/s^2 and rad/s^2."""
        return np.repeat((self.linear_m_s2, self.angular_rad_s2), 3)


def group_inputs(observation: Tensor, speed_m_s: float) -> Tensor:
    """The network's inputs, groups of ``GROUPS`` one after the other.

    Args:
        observation: As ``SealEnv`` documents it, shape (N, 35).
        speed_m_s: Nominal speed along the seam [m/s].

    Returns:
        Shape (N, 11), of about one in training.
    """
    o = torch.cat((observation, observation.new_full((len(observation), 1), speed_m_s / _MM)), dim=1)
    return o @ _INPUTS.to(o.dtype)


class SealNet(nn.Module):
    """Extractors, regressor and linear path; from observations to actions before they are clipped."""

    def __init__(self, cfg: PolicyCfg) -> None:
        """Builds the layers, with torch's global generator.

        Args:
            cfg: Kind and widths.
        """
        super().__init__()
        self.cfg = cfg
        width, hidden = cfg.extracted, cfg.hidden
        self.extractors = nn.ModuleDict(
            {
                name: nn.Sequential(nn.Linear(size, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh())
                for name, size in GROUPS.items()
            }
        )
        self.regressor = nn.Sequential(
            nn.Linear(width * len(GROUPS), hidden),
            nn.Tanh(),
            nn.Linear(hidden, hidden),
            nn.Tanh(),
            nn.Linear(hidden, ACCELS + (CHOLESKY if cfg.kind == "neural_rmp" else 0)),
        )
        self.linear = nn.Linear(sum(GROUPS.values()), ACCELS, bias=False)
        nn.init.zeros_(self.linear.weight)

    def forward(self, observation: Tensor) -> Tensor:
        """Actions, finite but not clipped; the metric's diagonal is positive.

        Args:
            observation: Shape (N, 35).

        Returns:
            Shape (N, 27) for ``control="rmp"``, (N, 6) for ``"tip"``.
        """
        inputs = group_inputs(observation, self.cfg.speed_m_s)
        groups = zip(self.extractors.values(), torch.split(inputs, list(GROUPS.values()), dim=1), strict=True)
        out = self.regressor(torch.cat([extract(group) for extract, group in groups], dim=1))
        accel: Tensor = out[:, :ACCELS] + self.linear(inputs)
        if self.cfg.kind == "neural_control":
            return accel
        metric = _definite(out[:, ACCELS:]) if self.cfg.kind == "neural_rmp" else _identity(accel)
        return torch.cat((accel, metric), dim=1)


def _definite(entries: Tensor) -> Tensor:
    """Cholesky entries whose diagonal is positive, so that ``A = L L^T`` is positive definite."""
    return torch.where(_ON_DIAGONAL, _SMALLEST_DIAGONAL + nn.functional.softplus(entries), entries)


def _identity(like: Tensor) -> Tensor:
    """Cholesky entries of A = I for each row."""
    entries = like.new_zeros((len(like), CHOLESKY))
    entries[:, list(_DIAGONAL)] = _UNIT_METRIC
    return entries


class LearnedPolicy:
    """A network with Stable-Baselines3's ``predict``.

    Attributes:
        cfg: What it is.
        net: The network.
        control: The ``control`` its environment needs.
        card: Where the weights are from; empty for a network that was not loaded.
    """

    def __init__(
        self, cfg: PolicyCfg, net: SealNet | None = None, card: Mapping[str, Any] | None = None
    ) -> None:
        """Takes the network.

        Args:
            cfg: What it is.
            net: The network; a new one by default.
            card: Where the weights are from.
        """
        self.cfg, self.control = cfg, cfg.control
        self.net = net or SealNet(cfg)
        self.card = dict(card or {})

    @classmethod
    def fresh(cls, kind: str, seed: int, cell: CellCfg | None = None) -> "LearnedPolicy":
        """A policy that has learned nothing yet.

        Args:
            kind: One of ``KINDS``.
            seed: Of the weights.
            cell: Speed and limits.

        Returns:
            The policy; torch's global generator is left as it was.
        """
        cfg = PolicyCfg.of(kind, cell)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return cls(cfg, SealNet(cfg))

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return sum(p.numel() for p in self.net.parameters())

    def check_cell(self, cell: CellCfg) -> None:
        """Refuses a cell in which the actions would mean something else.

        Args:
            cell: Of the environment.

        Raises:
            ConfigError: If speed or limits differ from those it was trained with.
        """
        theirs = PolicyCfg.of(self.cfg.kind, cell)
        for name in ("speed_m_s", "linear_m_s2", "angular_rad_s2"):
            ours, given = getattr(self.cfg, name), getattr(theirs, name)
            require(
                ours == given,
                f"the policy was trained with {name} = {ours}, the cell has {given}: train it anew",
            )

    def predict(
        self,
        observation: NDArray[np.float32] | dict[str, NDArray[Any]],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Actions for observations, as Stable-Baselines3's policies give them.

        Args:
            observation: Of one environment or of N, as ``SealEnv`` documents it.
            state: Passed through: the policy has no memory.
            episode_start: Not needed.
            deterministic: The policy always is.

        Returns:
            Actions of shape (k,) or (N, k) in [-1, 1], and the state.
        """
        del episode_start, deterministic
        rows, many = rows_of(observation)
        action = self._act(rows)
        return (action if many else action[0]), state

    def _act(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        # Row by row: a product over all rows may round otherwise than one over a single row.
        with torch.inference_mode(), _one_thread():
            out = [self.net(torch.from_numpy(row[None])).numpy() for row in rows]
        action = np.concatenate(out)
        lost = ~read(rows).seen
        if lost.any():
            action[lost] = _brake(read(rows[lost]), self.cfg)
        return np.asarray(np.minimum(np.maximum(action, -1.0), 1.0), dtype=np.float32)


def _brake(now: Reading, cfg: PolicyCfg) -> Array:
    """Brings the tip to rest against the seam; needs no feature of a view.

    With ``control="rmp"`` the fixed damping leaf goes on pulling towards the nominal speed: that pull is
    taken off, weighted as the leaf's metric and the policy's.
    """
    accel = -_BRAKE_S * (now.twist - now.seam_twist)
    if cfg.control == "tip":
        return accel / cfg.scale
    diagonal = 1.0 if cfg.kind == "neural_rmp" else _UNIT_METRIC
    damping = DampingCfg()
    accel[:, 1] -= damping.weight * damping.damping_s * cfg.speed_m_s / (CHOLESKY_SCALE * diagonal) ** 2
    entries = np.zeros((len(accel), CHOLESKY))
    entries[:, _DIAGONAL] = diagonal
    return np.concatenate((accel / cfg.scale, entries), axis=1)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keeps torch from waking its threads for a handful of numbers."""
    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# -- files ----------------------------------------------------------------------------------------------


def card_path(path: str | Path) -> Path:
    """The card's file beside a weights file.

    Args:
        path: ``NAME.safetensors``.

    Returns:
        ``NAME.json``.
    """
    return Path(path).with_suffix(".json")


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file such that a kill leaves the old one or the new one, never a part.

    Args:
        path: The file.
        data: What to write.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def save(policy: LearnedPolicy, path: str | Path, card: Mapping[str, Any]) -> None:
    """Writes a policy: ``NAME.safetensors`` with the weights, ``NAME.json`` with the card.

    Args:
        policy: To write.
        path: ``NAME.safetensors``.
        card: Where it comes from (data, command, seed, stack, scores), ready for JSON. ``format``,
            ``version``, ``config``, ``parameters`` and ``sha256`` are added.

    Raises:
        ConfigError: If the path ends otherwise.
        PolicyFileError: If a weight is not finite.
    """
    path = _weights_path(path)
    tensors = {name: tensor.detach().contiguous() for name, tensor in policy.net.state_dict().items()}
    _check_finite(tensors, path)
    data = write_tensors(tensors)
    written = {
        **card,
        "format": FORMAT,
        "version": VERSION,
        "config": asdict(policy.cfg),
        "parameters": policy.parameters,
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    text = json.dumps(written, indent=2, sort_keys=True, allow_nan=False) + "\n"
    write_whole(path, data)
    write_whole(card_path(path), text.encode())


def load(path: str | Path) -> LearnedPolicy:
    """Reads a policy that ``save`` wrote. Nothing in the files is executed.

    Args:
        path: ``NAME.safetensors``; the card ``NAME.json`` stands beside it.

    Returns:
        The policy.

    Raises:
        ConfigError: If the path ends otherwise.
        PolicyFileError: If a file is missing, truncated, damaged or not a policy's.
    """
    path = _weights_path(path)
    card = read_card(path)
    cfg = _config(card, path)
    data = _bytes(path)
    if hashlib.sha256(data).hexdigest() != card.get("sha256"):
        raise PolicyFileError(
            f"{path.name} is not the file that {card_path(path).name} describes (its SHA-256 differs): "
            "truncated, damaged or of another policy; copy both files again"
        )
    policy = LearnedPolicy(cfg, card=card)
    policy.net.load_state_dict(_tensors(data, policy.net.state_dict(), path))
    return policy


def read_card(path: str | Path) -> dict[str, Any]:
    """The card of a policy.

    Args:
        path: ``NAME.safetensors``.

    Returns:
        Its entries.

    Raises:
        PolicyFileError: If there is none, or it is none of ours.
    """
    file = card_path(_weights_path(path))
    try:
        card = json.loads(_bytes(file).decode())
    except (ValueError, RecursionError) as error:
        raise PolicyFileError(f"{file.name} is no card of a policy: not JSON ({error})") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise PolicyFileError(f"{file.name} is no card of a policy: it does not say format = {FORMAT!r}")
    if card.get("version") != VERSION:
        raise PolicyFileError(
            f"{file.name} has version {card.get('version')!r}: this release reads {VERSION}; train it anew"
        )
    return card


def control_in(path: str | Path) -> str:
    """The control mode of a policy, from its card.

    Args:
        path: ``NAME.safetensors``.

    Returns:
        The ``control`` its environment needs.

    Raises:
        PolicyFileError: If there is no card, or it is none of ours.
    """
    return _config(read_card(path), Path(path)).control


def _weights_path(path: str | Path) -> Path:
    path = Path(path)
    require(
        path.suffix == ".safetensors", f"path = {str(path)!r}: a policy's weights are in NAME.safetensors"
    )
    return path


def _bytes(path: Path) -> bytes:
    try:
        if path.stat().st_size > _LONGEST_FILE:
            raise PolicyFileError(
                f"{path.name} has {path.stat().st_size} bytes: no policy of ours is so large"
            )
        return path.read_bytes()
    except OSError as error:
        raise PolicyFileError(
            f"{path} cannot be read ({error.strerror}): a policy is NAME.safetensors with NAME.json beside it"
        ) from error


def _config(card: dict[str, Any], path: Path) -> PolicyCfg:
    values, names = card.get("config"), {f.name for f in fields(PolicyCfg)}
    if not isinstance(values, dict) or set(values) != names:
        raise PolicyFileError(f"{card_path(path).name}: config must have the entries {sorted(names)}")
    try:
        return PolicyCfg(**values)
    except ConfigError as error:
        raise PolicyFileError(f"{card_path(path).name}: {error}") from error


def _tensors(data: bytes, expected: Mapping[str, Tensor], path: Path) -> dict[str, Tensor]:
    try:
        tensors = read_tensors(data)
    except (SafetensorError, ValueError, KeyError) as error:
        raise PolicyFileError(f"{path.name} is no safetensors file, or a damaged one: {error}") from error
    check_tensors(tensors, expected, path)
    return tensors


def check_tensors(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor], path: Path) -> None:
    """Refuses tensors that are not those expected.

    Args:
        tensors: As read.
        expected: Of the right names, shapes and types.
        path: Named in errors.

    Raises:
        PolicyFileError: If names, shapes or types differ, or a value is not finite.
    """
    if set(tensors) != set(expected):
        missing, foreign = sorted(set(expected) - set(tensors)), sorted(set(tensors) - set(expected))
        raise PolicyFileError(
            f"{path.name} holds other tensors: {missing} are missing, {foreign} are foreign"
        )
    for name, tensor in tensors.items():
        wanted = expected[name]
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise PolicyFileError(
                f"{path.name}: {name} is {tensor.dtype} of shape {tuple(tensor.shape)}, "
                f"must be {wanted.dtype} of shape {tuple(wanted.shape)}"
            )
    _check_finite(tensors, path)


def _check_finite(tensors: Mapping[str, Tensor], path: Path) -> None:
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise PolicyFileError(f"{path.name}: {name} has values that are not finite")
