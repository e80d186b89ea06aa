"""What a kernel is given with every frame, unpacked once.

Handing some forty arrays from Python to a kernel takes several microseconds, every time. A ``Held`` object
has them in the form that compiled code works with; the arrays themselves stay those of Python.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.experimental import structref

from gateway.geometry.compiled import compiled


@structref.register
class HeldType(types.StructRef):
    """Numba's side of ``Held``."""

    def preprocess_fields(self, fields: Any) -> Any:
        """Values are variables, not constants of the type: one compiled kernel serves all."""
        unliteral: Any = types.unliteral
        return tuple((name, unliteral(field)) for name, field in fields)


class Held(structref.StructRefProxy):
    """Made by ``hold``."""

    all: Any
    """Read by kernels only."""

    def __new__(cls, everything: Any) -> Held:
        """See ``hold``."""
        held: Held = _hold(everything)
        return held


structref.define_proxy(Held, HeldType, ["all"])  # type: ignore[no-untyped-call]  # numba's


@compiled
def _hold(everything: Any) -> Any:
    return Held(everything)


def hold(everything: tuple[Any, ...]) -> Held:
    """A tuple of arrays, numbers and named tuples as one argument; in a kernel ``held.all`` is the tuple."""
    return Held(everything)
