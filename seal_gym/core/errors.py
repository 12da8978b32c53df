"""The package's errors: one base class, so that a caller can catch all of them at once."""

import math
import numbers


class SealGymError(Exception):
    """Base of every error this package raises on purpose."""


class ConfigError(SealGymError, ValueError):
    """A configuration value is outside its allowed range."""


class SeamError(SealGymError, ValueError):
    """A seam or workpiece cannot be built or cannot be sealed by this cell."""


class ActionError(SealGymError, ValueError):
    """An action has the wrong shape or is not finite."""


class RenderError(SealGymError, RuntimeError):
    """A picture cannot be made on this machine."""


class PhysicsError(SealGymError, RuntimeError):
    """The physics engine reported an error or produced a state that is not finite."""


def is_number(value: object) -> bool:
    """Whether a value is a finite number; True and False are none.

    Args:
        value: Anything a user may have passed.

    Returns:
        Whether it is.
    """
    return not isinstance(value, bool) and isinstance(value, numbers.Real) and math.isfinite(value)


def require(condition: bool, message: str, error: type[SealGymError] = ConfigError) -> None:
    """Raises ``error`` with ``message`` unless ``condition`` holds.

    Args:
        condition: What must be true.
        message: Names the value, the allowed range and the fix.
        error: The class to raise.

    Raises:
        SealGymError: If the condition is false; of the given class.
    """
    if not condition:
        raise error(message)
