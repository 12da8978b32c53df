"""Compilation of the scalar kernels that run once per simulation and frame.

Kernels are plain loops over scalars: every simulation of a batch runs the same instructions in the
same order, so N = 1 and N > 1 agree to the bit, which blocked linear algebra does not promise.
"""

from collections.abc import Callable
from typing import Any

import numba


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles ``function`` with numba: cached on disk, without the GIL, without fast-math.

    Fast-math stays off because it reorders sums, and images and trajectories have to repeat bit for
    bit.
    """
    compiled: Callable[..., Any] = numba.njit(cache=True, nogil=True, fastmath=False)(function)
    return compiled
