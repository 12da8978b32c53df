"""Range checks shared by the configurations."""

import math

from seal_gym.core.errors import require


def require_positive(cfg: object, *names: str) -> None:
    """Raises unless each named attribute is a positive finite number.

    Args:
        cfg: A configuration.
        *names: Its attributes.

    Raises:
        ConfigError: Naming the value and the range.
    """
    for name in names:
        value = getattr(cfg, name)
        message = f"{type(cfg).__name__}.{name} is {value}; give a positive finite number"
        require(0.0 < value < math.inf, message)


def require_share(cfg: object, name: str) -> None:
    """Raises unless the named attribute lies in (0, 1].

    Args:
        cfg: A configuration.
        name: Its attribute.

    Raises:
        ConfigError: Naming the value and the range.
    """
    value = getattr(cfg, name)
    require(0.0 < value <= 1.0, f"{type(cfg).__name__}.{name} is {value}; give a share in (0, 1]")
