"""The one way in which kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Numba, cached on disk, with IEEE division (x / 0 is inf or NaN, never an exception).

    Reassociation of sums stays off: the same input gives the same bits.
    """
    return cast(F, njit(cache=True, error_model="numpy")(function))
