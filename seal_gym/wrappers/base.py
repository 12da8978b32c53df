"""What all disturbances share: a frozen configuration with a severity, and random streams of their own."""

import copy
import zlib
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Self

import numpy as np

from seal_gym.core.errors import ConfigError, is_number, require

MAX_SEVERITY = 10.0
Words = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class DisturbanceCfg:
    """One disturbance.

    Attributes:
        severity: 0 is off, 1 the default; amplitudes and speeds grow in proportion to it.
    """

    severity: float = 1.0

    name: ClassVar[str]
    """As it stands in JSON."""
    version: ClassVar[int] = 1
    """Goes up with each change that gives another run for the same configuration and seed."""

    def __post_init__(self) -> None:
        """Checks the severity, and the ranges of the subclass."""
        _number(self, "severity", 0.0, MAX_SEVERITY)
        self.check()

    def check(self) -> None:
        """Checks the ranges; for subclasses with attributes of their own."""

    def to_dict(self) -> dict[str, Any]:
        """Everything that decides the disturbance, ready for JSON.

        Returns:
            ``name``, ``version`` and the attributes.
        """
        return {"name": self.name, "version": self.version, **asdict(self)}

    @classmethod
    def of(cls, **kwargs: Any) -> Self:
        """Builds it from keyword arguments.

        Args:
            **kwargs: The attributes, and perhaps the version they were written by.

        Returns:
            The configuration.

        Raises:
            ConfigError: If a name is unknown, a value out of range or the version another one.
        """
        version = kwargs.pop("version", cls.version)
        require(
            version == cls.version,
            f"{cls.name} of version {version!r}: this is version {cls.version}, which gives other runs; use "
            "the release that wrote it, or leave the version out",
        )
        names = [f.name for f in fields(cls)]
        unknown = sorted(set(kwargs) - set(names))
        if unknown:
            raise ConfigError(f"unknown keyword argument {unknown}: {cls.name} takes {names}")
        return cls(**kwargs)


def _number(cfg: Any, name: str, low: float, high: float) -> None:
    value = getattr(cfg, name)
    require(
        is_number(value) and low <= value <= high,
        f"{type(cfg).__name__}.{name} = {value!r}: must be a number within {low:g}..{high:g}",
    )


def check_numbers(cfg: Any, **ranges: tuple[float, float]) -> None:
    """Refuses attributes outside their range.

    Args:
        cfg: A configuration.
        **ranges: Lowest and highest value by attribute.

    Raises:
        ConfigError: If one is no number or outside.
    """
    for name, (low, high) in ranges.items():
        _number(cfg, name, low, high)


def check_choice(cfg: Any, name: str, allowed: tuple[str, ...]) -> None:
    """Refuses an attribute that is none of the choices.

    Args:
        cfg: A configuration.
        name: Of the attribute.
        allowed: The choices.

    Raises:
        ConfigError: If it is something else.
    """
    value = getattr(cfg, name)
    require(value in allowed, f"{type(cfg).__name__}.{name} = {value!r}: must be one of {list(allowed)}")


def fork(rng: np.random.Generator) -> Words:
    """Words that seed an episode's disturbances: the generator's next ones, which it still has to give.

    Args:
        rng: The environment's generator; it is left as it is, so that a disturbance changes no other draw.

    Returns:
        Four 64-bit words.
    """
    ahead = copy.deepcopy(rng.bit_generator)
    return tuple(int(word) for word in ahead.random_raw(4))


def stream(words: Words, name: str) -> np.random.Generator:
    """A disturbance's own generator for an episode, whatever other disturbances there are.

    Args:
        words: From ``fork``.
        name: Of the disturbance.

    Returns:
        The generator.
    """
    return np.random.Generator(np.random.PCG64([*words, zlib.crc32(name.encode())]))
