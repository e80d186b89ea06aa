"""What a stage is: observations of one kind put together by instant, and solved."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from gateway.body.skeleton import WornSuit
from gateway.contract.balances import Balance
from gateway.frames import SkeletonFrame
from gateway.reconstruction import RootSettings
from gateway.sources.despiking import Despiker
from gateway.sources.module_table import ModuleTable
from gateway.stages.frame_assembler import AssemblyParams

Frame = TypeVar("Frame")
"""All observations of one instant: what the stage's reconstructor takes."""


@dataclass(frozen=True)
class StageContext:
    """What a stage may need of its surroundings."""

    suit: WornSuit
    modules: ModuleTable
    params: AssemblyParams
    method: str
    """Name of the reconstructor."""
    root: RootSettings | None = None
    despiker: Despiker | None = None
    reference: int | None = None
    """Module whose instants count where orientations come fused; None: the first of the suit."""
    delay_s: float = 0.0
    """By which the method's frames come later and better."""


class Stage(Protocol[Frame]):
    """Sans-I/O, no clock of its own, deterministic.

    Assembly and solution are one stage, since what lies between them is of no use to anybody else; they are
    two calls, since a recording solves many frames at a time.
    """

    def add(self, observations: Sequence[Any], arrived_ns: int) -> list[Frame]:
        """Return the frames that observations, or the time they arrived (gateway time, ns), complete."""
        ...

    def solve(self, frames: Sequence[Frame]) -> list[SkeletonFrame]:
        """Return the poses of frames in time order; the same, bit for bit, one by one or many at a time."""
        ...

    def statistics(self) -> Mapping[str, object]:
        """Return counters for the health message, by section."""
        ...

    def balances(self) -> Iterable[Balance]:
        """Yield its shares of the balances: what became of observations, and of frames that gave no pose."""
        ...
