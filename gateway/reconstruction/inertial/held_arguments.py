"""What a kernel is given with every frame, handed over as one address.

Kernels take the body, the noise and the state, some sixty arrays in all. As named tuples they would go from
function to function by value, hundreds of machine words a call, which costs more than the arithmetic and has
the compiler spend a minute on moving them. ``hold`` writes once where the arrays lie into a table. In a
kernel ``held.name`` then is the array (no reference is counted: the ``Held`` object keeps it alive), the
number, or the inner tuple; all but the first length of an array is a constant of the type, so that loops over
3 × 3 and 6 × 6 blocks unroll. Code reads the same either way: a kernel can be given the named tuple, too.
"""

from __future__ import annotations

from typing import Any, TypeVar, cast

import numpy as np

T = TypeVar("T", bound=tuple[Any, ...])


class Held:
    """Made by ``hold``; its arrays must not be replaced, only changed in place."""

    def __init__(self, everything: tuple[Any, ...]) -> None:
        from gateway.reconstruction.inertial.held_types import layout  # noqa: PLC0415 - the compiler is slow

        words: list[int] = []
        self._numba_type_ = layout(everything, words)
        self._everything = everything
        self._table = np.array(words, np.int64)
        self.address: int = self._table.ctypes.data


def hold(everything: T) -> T:
    """A named tuple of arrays, numbers and such tuples as one argument of a kernel: to it, the tuple itself.

    Raises ``TypeError`` for anything else, and for arrays that kernels cannot change in place.
    """
    return cast(T, Held(everything))
