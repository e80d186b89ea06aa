"""What is to go wrong with an emulated suit, and when: the schema of ``emulate --faults FILE``.

    seed: 1
    faults:
      - {kind: loss, at: 5, lasts: 2, share: 0.3}
      - {kind: reset, at: 10, module: 4, lasts: 0.5, every: 30}

Times are seconds of motion time. A fault with ``every`` comes again for ever.

``FaultWindows`` says which are on at an instant. A schedule of an hour has a thousand faults of which one is
on: asking all of them at every transmission took most of the time of a simulated suit.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from typing import Annotated, ClassVar, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

Seconds = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, description="of what is sent")]
Module = Annotated[int, Field(ge=0, le=63, description="number of the module, as the rig names it")]
Sensor = Literal["specific_force", "angular_rate", "magnetic_field"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Fault(_Strict):
    """Anything that goes wrong, for a while."""

    is_instant: ClassVar[bool] = False
    """Whether it happens also where it lasts no time."""

    at: Seconds = Field(description="when it begins, s")
    lasts: Seconds = Field(default=0.0, description="for how long, s")
    every: float | None = Field(default=None, gt=0, le=1e6, description="it comes again after so long, s")

    @model_validator(mode="after")
    def _lasts(self) -> Fault:
        if not self.lasts and not self.is_instant:
            raise ValueError("say how long it 'lasts', s: so it would never happen")
        return self

    @model_validator(mode="after")
    def _ends_before_it_comes_again(self) -> Fault:
        if self.every is not None and self.every <= self.lasts:
            raise ValueError(f"every {self.every:g} s, but it lasts {self.lasts:g} s: it would never end")
        return self

    def starts(self, from_s: float, to_s: float) -> Iterator[float]:
        """Yield when it begins, s, within [from_s, to_s)."""
        if self.every is None:
            if from_s <= self.at < to_s:
                yield self.at
            return
        count = max(0, math.ceil((from_s - self.at) / self.every))
        while (start := self.at + count * self.every) < to_s:
            yield start
            count += 1

    def is_on(self, at_s: float) -> bool:
        """Return whether it lasts at a time, s."""
        since = at_s - self.at
        if self.every is not None and since >= 0:
            since %= self.every
        return 0 <= since < self.lasts


class BitErrors(Fault):
    """Bytes arrive with one bit turned over."""

    kind: Literal["bit_errors"]
    share: Share


class Loss(Fault):
    """Transmissions do not arrive."""

    kind: Literal["loss"]
    share: Share


class Duplication(Fault):
    """Transmissions arrive twice."""

    kind: Literal["duplication"]
    share: Share


class Reordering(Fault):
    """Transmissions are overtaken by what is sent after them."""

    kind: Literal["reordering"]
    share: Share
    delay: float = Field(default=0.03, gt=0, le=10, description="how much later they arrive, s")


class Burst(Fault):
    """Nothing arrives, and then all of it at once."""

    kind: Literal["burst"]


class Stall(Fault):
    """Nothing arrives, and what is sent meanwhile is lost, in both directions."""

    kind: Literal["stall"]


class SlowDrip(Fault):
    """The link passes bytes on one by one, slower than they are sent; at the end the rest comes at once."""

    kind: Literal["slow_drip"]
    bytes_per_s: float = Field(default=500.0, gt=0, le=1e7)


class Noise(Fault):
    """A babbling node: bytes that no device of the suit has sent (frames of others on CAN)."""

    kind: Literal["noise"]
    bytes_per_s: float = Field(default=1000.0, gt=0, le=1e6)


class Reset(Fault):
    """A module loses its power for ``lasts`` seconds; its clock and its numbers begin anew."""

    is_instant = True

    kind: Literal["reset"]
    module: Module


class ClockJump(Fault):
    """A module's counter jumps."""

    is_instant = True

    kind: Literal["clock_jump"]
    module: Module
    by: float = Field(ge=-1000, le=1000, description="by how much, s; backwards if negative")


class Stuck(Fault):
    """A sensor says the same again and again."""

    kind: Literal["stuck"]
    module: Module
    sensor: Sensor = "angular_rate"


class Saturated(Fault):
    """A sensor is at the end of its range on all axes."""

    kind: Literal["saturated"]
    module: Module
    sensor: Sensor = "angular_rate"


class Magnet(Fault):
    """A magnet passes a module: its field comes and goes, and turns as it passes."""

    kind: Literal["magnet"]
    module: Module
    field: float = Field(default=60.0, gt=0, le=5000, description="largest on the way, µT")

    def at_module(self, at_s: float) -> tuple[float, float, float]:
        """Return what it adds to the field that the module feels, sensor axes, µT."""
        passed = (at_s - self.at) % (self.every or math.inf) / self.lasts
        strength, turn = self.field * math.sin(math.pi * passed) ** 2, math.pi * passed
        return strength * math.cos(turn), strength * math.sin(turn), 0.3 * strength


class NotFinite(Fault):
    """A local measuring device says NaN (samples of inertial modules are whole numbers: they cannot)."""

    kind: Literal["not_finite"]
    module: Module


class IdConflict(Fault):
    """A module sends under the id of another one, too."""

    kind: Literal["id_conflict"]
    module: Module
    takes: Module


class Unplug(Fault):
    """The cable is pulled; plugged in again the port has another name (its link, if it has one, stays)."""

    kind: Literal["unplug"]


AnyFault = Annotated[
    BitErrors
    | Loss
    | Duplication
    | Reordering
    | Burst
    | Stall
    | SlowDrip
    | Noise
    | Reset
    | ClockJump
    | Stuck
    | Saturated
    | Magnet
    | NotFinite
    | IdConflict
    | Unplug,
    Field(discriminator="kind"),
]


class FaultPlan(_Strict):
    """All that goes wrong."""

    seed: int = Field(default=1, ge=0, le=2**32 - 1, description="of everything random in it")
    faults: tuple[AnyFault, ...] = ()

    def windows(self, *kinds: type[Fault]) -> list[Fault]:
        """Return the faults of some kinds."""
        return [fault for fault in self.faults if isinstance(fault, kinds)]


AnyOf = TypeVar("AnyOf", bound=Fault)
_ROUNDING_S = 1e-6
"""Stretches are so much longer at both ends: ``is_on`` itself decides at the edges."""


class FaultWindows(Generic[AnyOf]):
    """Faults by time. Instants may be asked for in any order."""

    def __init__(self, faults: Iterable[AnyOf], after_s: float = 0.0) -> None:
        """Index the faults; they are ``near`` until ``after_s`` after their end."""
        every = list(faults)
        self._edges: list[float] = [-float("inf")]
        self._near: list[tuple[int, ...]] = [()]
        """By stretch between two edges: places of the faults that come once."""
        self._faults = every
        self._after_s = after_s
        self._recurring = tuple(place for place, fault in enumerate(every) if fault.every is not None)
        self._starts = sorted((fault.at, place) for place, fault in enumerate(every) if fault.every is None)
        self._walk()

    def on(self, at_s: float) -> list[AnyOf]:
        """Return those that last at a time, s, in the order in which they were given."""
        return [fault for fault in self._candidates(at_s) if fault.is_on(at_s)]

    def starting(self, from_s: float, to_s: float) -> Iterator[tuple[float, AnyOf]]:
        """Yield when a fault begins, s, and which: all within [from_s, to_s), in the order given."""
        first, end = (bisect_left(self._starts, (edge_s, -1)) for edge_s in (from_s, to_s))
        places = sorted((*(place for _, place in self._starts[first:end]), *self._recurring))
        for place in places:
            fault = self._faults[place]
            for start_s in fault.starts(from_s, to_s):
                yield start_s, fault

    def near(self, at_s: float) -> bool:
        """Return whether any is on, or ended not longer ago than ``after_s``."""
        return any(_since(fault, at_s) <= fault.lasts + self._after_s for fault in self._candidates(at_s))

    def _candidates(self, at_s: float) -> Iterable[AnyOf]:
        places = self._near[bisect_right(self._edges, at_s) - 1]
        if self._recurring:
            places = tuple(sorted((*places, *self._recurring)))
        return (self._faults[place] for place in places)

    def _walk(self) -> None:
        """List, from edge to edge, those begun and not yet over."""
        changes: list[tuple[float, int]] = []
        for place, fault in enumerate(self._faults):
            if fault.every is None:
                changes.append((fault.at - _ROUNDING_S, place))
                changes.append((fault.at + fault.lasts + self._after_s + _ROUNDING_S, place))
        begun: set[int] = set()
        for edge_s, place in sorted(changes):
            # A fault has two edges: at the first it comes in, at the second it goes out.
            begun ^= {place}
            self._edges.append(edge_s)
            self._near.append(tuple(sorted(begun)))


def _since(fault: Fault, at_s: float) -> float:
    """Since it began last, s; infinite before it did."""
    since = at_s - fault.at
    if since < 0.0:
        return float("inf")
    return since if fault.every is None else since % fault.every
