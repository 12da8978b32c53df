"""Compilation of the scalar kernels that run once per simulation and frame.

Kernels are plain loops over scalars: every simulation of a batch runs the same instructions in the
same order, so N = 1 and N > 1 agree to the bit, which blocked linear algebra does not promise.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compiles ``function`` with numba: cached on disk, without the GIL, without fast-math.

    Fast-math stays off because it reorders sums, and images and trajectories have to repeat bit for
    bit.
    """
    return cast(F, numba.njit(cache=True, nogil=True, fastmath=False)(function))
