"""The disturbances there are, by name, and the lists of them that environments take."""

from collections.abc import Iterable, Mapping
from typing import Any

from seal_gym.core.errors import ConfigError, require
from seal_gym.wrappers.actuation_delay import ActuationDelayCfg
from seal_gym.wrappers.base import DisturbanceCfg
from seal_gym.wrappers.cameras import CameraDropoutCfg, CameraLatencyCfg, CameraNoiseCfg, HandEyeErrorCfg
from seal_gym.wrappers.external_push import ExternalPushCfg
from seal_gym.wrappers.lighting import LightingCfg
from seal_gym.wrappers.moving_obstacle import MovingObstacleCfg
from seal_gym.wrappers.moving_workpiece import MovingWorkpieceCfg

KINDS: dict[str, type[DisturbanceCfg]] = {
    kind.name: kind
    for kind in (
        MovingWorkpieceCfg,
        MovingObstacleCfg,
        LightingCfg,
        CameraNoiseCfg,
        CameraDropoutCfg,
        CameraLatencyCfg,
        ExternalPushCfg,
        HandEyeErrorCfg,
        ActuationDelayCfg,
    )
}
NAMES = tuple(KINDS)


def disturbance(given: object) -> DisturbanceCfg:
    """One disturbance, however it is written.

    Args:
        given: A configuration, a name, or a mapping of ``name`` and attributes as from JSON.

    Returns:
        The configuration.

    Raises:
        ConfigError: If it is none of these, or a value is out of range.
    """
    if isinstance(given, DisturbanceCfg):
        return given
    values = dict(given) if isinstance(given, Mapping) else {"name": given}
    name = values.pop("name", None)
    if not isinstance(name, str) or name not in KINDS:
        raise ConfigError(
            f"disturbance {given!r}: must be a name of {list(NAMES)}, or a mapping with such a 'name'"
        )
    return KINDS[name].of(**values)


def disturbances(given: object) -> tuple[DisturbanceCfg, ...]:
    """A list of disturbances, however they are written.

    Args:
        given: As ``disturbance`` takes them.

    Returns:
        The configurations in the given order, which means nothing.

    Raises:
        ConfigError: If one is wrong, or of a kind there are two.
    """
    require(
        isinstance(given, Iterable) and not isinstance(given, str | Mapping),
        f"disturbances = {given!r}: must be a list, each entry a name or a mapping with a 'name'",
    )
    assert isinstance(given, Iterable)
    out = tuple(disturbance(one) for one in given)
    names = [d.name for d in out]
    twice = sorted({n for n in names if names.count(n) > 1})
    require(not twice, f"disturbances {twice} stand there twice: one of each kind, with what it is to do")
    return out


def dynamic_regime(severity: float = 1.0) -> list[dict[str, Any]]:
    """The dynamic regime of Table 4 (protocol.md): the part moves and turns, the light varies in time.

    Args:
        severity: Scales amplitudes and speeds.

    Returns:
        What the environments' ``disturbances`` takes, ready for JSON.
    """
    return [
        MovingWorkpieceCfg(severity=severity).to_dict(),
        LightingCfg(severity=severity, shadow=0.0).to_dict(),
    ]
