"""State of each module, as listed and as published from time to time.

Whether a module is heard is judged by packets coming in from one look to the next, not by their arrival
times: a recording's are those of the day it was made.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pydantic import Field

from devices.commands.roster import Conflict, Device, Roster
from firmware_protocol.kinds import Kind
from gateway.body.skeleton import WornSuit
from gateway.contract.messages import Message, ModuleAvailability, ModuleClockState, ModuleState
from gateway.contract.topics import MODULE_AVAILABILITY, MODULE_STATE
from gateway.modules.makers import MakersModule
from gateway.sources.statistics import ModuleRecord
from gateway.sources.suit import SuitSource
from gateway.support.settings_files import Strict

SAMPLE_KINDS = (
    Kind.INERTIAL_SAMPLE,
    Kind.INERTIAL_SAMPLE_FINE,
    Kind.FUSED_SAMPLE,
    Kind.LOCAL_MEASUREMENT,
    Kind.PRESSURE_SAMPLE,
)
"""Kinds that have a rate published."""


class ModuleSummary(Strict):
    """One device that answered, or is only heard sending."""

    module: int = Field(description="module id; 254 is the relay")
    answers: bool = Field(description="false: it sends, but does not answer commands")
    unique_id: str | None = Field(description="none: it has neither answered nor said who it is")
    segment: str | None = Field(description="by the rig; none: the rig has no module of this id")
    link: str | None = None
    firmware: str | None = None
    protocol: int | None = Field(default=None, description="version spoken; none: none in common")
    battery_percent: int | None = None
    rssi_dbm: int | None = Field(default=None, description="strength of its radio signal; none: not told")
    rate_hz: float = Field(description="samples a second, measured")
    loss_percent: float | None = Field(description="packets lost since the link is read")
    clock: ModuleClockState | None = Field(default=None, description="none: never heard sending")
    resets: int = Field(default=0, description="how often it was found to count from anew")
    gaps: dict[str, int] = Field(default={}, description="how often so many packets were lost in a row")


class ConflictSummary(Strict):
    """A module id that several devices have."""

    module: int
    unique_ids: tuple[str, ...]


class ModuleList(Strict):
    """Who is there."""

    modules: tuple[ModuleSummary, ...]
    conflicts: tuple[ConflictSummary, ...]
    segments: dict[str, int] = Field(description="module id that the rig gives to each segment")


class SampleCounts(NamedTuple):
    """Sample counts at one moment, for rates."""

    time_ns: int
    samples: dict[int, int]


def segments_of(suit: WornSuit) -> dict[str, int]:
    """Return module id by segment, for the segments that wear one."""
    worn = zip(suit.skeleton.segment_names, suit.module_of_segment.tolist(), strict=True)
    return {name: suit.module_ids[row] for name, row in worn if row >= 0}


def module_names(suit: WornSuit) -> dict[int, str]:
    """Return what each module or local device of the rig is on, by id."""
    return {module: segment for segment, module in segments_of(suit).items()} | local_devices_of(suit)


def local_devices_of(suit: WornSuit) -> dict[int, str]:
    """Return what to call the local measuring devices, by id."""
    return {
        local.device: f"{suit.skeleton.segment_names[local.segment]} ({local.quantity.name.lower()})"
        for local in suit.local_devices
        if local.device is not None
    }


def count_samples(stream: SuitSource, time_ns: int) -> SampleCounts:
    """Return samples received so far, by module id."""
    return SampleCounts(
        time_ns, {module: count_module_samples(record) for module, record in stream.modules.items()}
    )


def summarise(
    roster: Roster,
    stream: SuitSource,
    suit: WornSuit,
    before: SampleCounts,
    after: SampleCounts,
    makers: Mapping[int, MakersModule] | None = None,
) -> ModuleList:
    """Return the list of a roster, with rates between two counts. makers: modules of others that answered, by
    id."""
    makers = makers or {}
    segments = segments_of(suit)
    names = module_names(suit)
    # Counts of one instant have no rate, and must not divide by zero.
    span_s = max((after.time_ns - before.time_ns) * 1e-9, 1e-9)
    rates = {
        module: (count - before.samples.get(module, 0)) / span_s for module, count in after.samples.items()
    }
    answering = [
        _summary(device.module, device, stream.modules.get(device.module), names, rates)
        for device in roster.devices
    ]
    known = {device.module for device in roster.devices}
    # Modules that send and do not answer commands belong into the list too.
    silent = [
        _answering(_summary(module, None, record, names, rates), makers.get(module))
        for module, record in sorted(stream.modules.items())
        if module not in known and (rates.get(module) or module in makers)
    ]
    return ModuleList(
        modules=tuple(sorted([*answering, *silent], key=lambda each: each.module)),
        conflicts=tuple(map(_conflict, roster.conflicts)),
        segments=segments,
    )


def _summary(
    module: int,
    device: Device | None,
    record: ModuleRecord | None,
    names: Mapping[int, str],
    rates: Mapping[int, float],
) -> ModuleSummary:
    info = (device.info if device is not None else None) or (record.info if record is not None else None)
    health = device.health if device is not None else record.health if record is not None else None
    uid = device.unique_id if device is not None else info.unique_id if info is not None else None
    return ModuleSummary(
        module=module,
        answers=device is not None,
        unique_id=None if uid is None else uid.hex(),
        segment=names.get(module),
        link=device.link if device is not None else None,
        firmware=".".join(map(str, info.firmware_version)) if info is not None else None,
        protocol=device.version if device is not None else None,
        battery_percent=health.battery_percent if health is not None else None,
        rssi_dbm=health.rssi_dbm if health is not None else None,
        rate_hz=round(rates.get(module, 0.0), 1),
        loss_percent=_loss_percent(record),
        clock=None if record is None else clock_state(record),
        resets=0 if record is None else record.clock.restarts,
        gaps={} if record is None else record.gap_histogram,
    )


def _answering(summary: ModuleSummary, other: MakersModule | None) -> ModuleSummary:
    """Return the summary of a module that is heard, with what one of another maker has answered."""
    if other is None:
        return summary
    reported = {"answers": True, "unique_id": other.unique_id, "link": other.link}
    return summary.model_copy(update={**reported, "firmware": other.description.firmware})


def _conflict(conflict: Conflict) -> ConflictSummary:
    return ConflictSummary(
        module=conflict.module, unique_ids=tuple(unique_id.hex() for unique_id in conflict.unique_ids)
    )


def count_module_samples(record: ModuleRecord) -> int:
    """Return samples received of one module."""
    return sum(record.sequences[kind].received for kind in SAMPLE_KINDS if kind in record.sequences)


def clock_state(record: ModuleRecord) -> ModuleClockState:
    """Return a module's clock as published."""
    figures = record.clock.figures()
    return ModuleClockState(
        state="settled" if figures.is_settled else "measuring",
        offset_ns=figures.offset_ns,
        ppm=round(figures.skew_ppm, 2) if figures.is_settled else None,
        residual_us=round(figures.residual_us, 1),
        sigma_us=round(figures.sigma_us, 1),
        bound_us=None if figures.bound_us is None else round(figures.bound_us, 1),
        steps=figures.steps,
    )


def _loss_percent(record: ModuleRecord | None) -> float | None:
    if record is None or not record.received:
        return None
    return round(100 * record.lost / (record.received + record.lost), 2)


_RATE_WINDOW_NS = 2_000_000_000
_RATE_FROM_NS = 900_000_000
"""A rate of a shorter time would say more of when we looked than of the module."""


@dataclass
class _Watched:
    """One module as seen so far."""

    module: int
    segment: str | None
    is_online: bool = False
    packets: int = 0
    received_ns: int | None = None
    """When packets were last found to have come."""
    samples: deque[tuple[int, int]] = field(default_factory=deque)
    """(when, samples until then) of recent looks."""
    published_ns: int | None = None
    published: ModuleState | None = None

    def look(self, record: ModuleRecord, now_ns: int) -> None:
        """Take note of what has come since the last look."""
        packets = record.received + record.duplicates
        if packets != self.packets:
            self.packets, self.received_ns = packets, now_ns
        self.samples.append((now_ns, count_module_samples(record)))
        while now_ns - self.samples[0][0] > _RATE_WINDOW_NS:
            self.samples.popleft()

    @property
    def rate_hz(self) -> float | None:
        if not self.samples:
            return None
        (first_ns, first), (last_ns, last) = self.samples[0], self.samples[-1]
        span_ns = last_ns - first_ns
        return round((last - first) * 1e9 / span_ns, 1) if span_ns >= _RATE_FROM_NS else None


class ModuleStates:
    """The modules of the rig, and all others that are heard.

    silent_after_ns: a module counts as offline after so long without a packet.
    interval_ns: the figures of one module are sent at most so often; silence and return are sent at once.
    late: samples that came too late for their frame, by module.
    doubts: asked why modules' segments are doubtful, by module; a new doubt is sent at once.
    """

    def __init__(
        self,
        stream: SuitSource,
        suit: WornSuit,
        *,
        silent_after_ns: int,
        interval_ns: int,
        late: Mapping[int, int] | None = None,
        doubts: Callable[[], Mapping[int, str]] = dict,
    ) -> None:
        self._stream = stream
        self._silent_after_ns = silent_after_ns
        self._interval_ns = interval_ns
        self._late: Mapping[int, int] = Counter() if late is None else late
        self._doubts = doubts
        self._doubted: Mapping[int, str] = {}
        self._names = module_names(suit)
        self._watched = {module: _Watched(module, name) for module, name in sorted(self._names.items())}
        self._started_ns: int | None = None

    def look(self, now_ns: int) -> Iterator[tuple[str, Message]]:
        """Yield the topics (below the gateway's) and messages that are due. Call it a few times a second."""
        if self._started_ns is None:
            self._started_ns = now_ns
        # Modules appear whenever they are heard first.
        for module, record in self._stream.modules.items():
            if module not in self._watched:
                self._watched[module] = _Watched(module, self._names.get(module))
            self._watched[module].look(record, now_ns)
        self._doubted = self._doubts()
        for watched in self._watched.values():
            yield from self._news(watched, now_ns)

    def farewell(self, now_ns: int) -> Iterator[tuple[str, Message]]:
        """Yield what is to be said when the gateway stops: every module is offline."""
        for watched in self._watched.values():
            watched.is_online = False
            yield from self._publish(watched, self.state(watched.module, now_ns), is_change=True)

    def states(self, now_ns: int) -> list[ModuleState]:
        """Return the figures of all modules as of the last look, by id."""
        return [self.state(module, now_ns) for module in sorted(self._watched)]

    def state(self, module: int, now_ns: int) -> ModuleState:
        """Return the figures of one module. Raises ``KeyError`` for one that is neither in the rig nor
        heard."""
        watched, record = self._watched[module], self._stream.modules.get(module)
        last_ns = None if record is None else record.last_arrival_ns
        reported = _reported(record)
        return ModuleState(
            t_ns=now_ns,
            module=module,
            segment=watched.segment,
            availability="online" if watched.is_online else "offline",
            doubt=self._doubted.get(module),
            silent_since_ns=None if watched.is_online else last_ns,
            last_arrival_ns=last_ns,
            rate_hz=watched.rate_hz,
            late=self._late.get(module, 0),
            clock=None if record is None else clock_state(record),
            **reported,
        )

    def _news(self, watched: _Watched, now_ns: int) -> Iterator[tuple[str, Message]]:
        received_ns = watched.received_ns
        is_online = received_ns is not None and now_ns - received_ns <= self._silent_after_ns
        is_first = watched.published is None
        if is_first and not is_online and now_ns - (self._started_ns or 0) <= self._silent_after_ns:
            return  # it may just be slow to begin
        is_change = is_first or is_online != watched.is_online
        watched.is_online = is_online
        is_due = watched.published_ns is None or now_ns - watched.published_ns >= self._interval_ns
        doubt = None if watched.published is None else watched.published.doubt
        is_new_doubt = (doubt is None) != (watched.module not in self._doubted)
        if not (is_change or is_due or is_new_doubt):
            return
        state = self.state(watched.module, now_ns)
        if is_change or watched.published is None or _differs(state, watched.published):
            yield from self._publish(watched, state, is_change)

    def _publish(
        self, watched: _Watched, state: ModuleState, is_change: bool
    ) -> Iterator[tuple[str, Message]]:
        watched.published_ns, watched.published = state.t_ns, state
        if is_change:
            topic = MODULE_AVAILABILITY.format(id=watched.module)
            yield topic, ModuleAvailability(state=state.availability)
        yield MODULE_STATE.format(id=watched.module), state


def _reported(record: ModuleRecord | None) -> dict[str, Any]:
    """Return what was counted of a module, and what it says of itself."""
    health = None if record is None else record.health
    info = None if record is None else record.info
    return {
        "received": 0 if record is None else record.received,
        "lost": 0 if record is None else record.lost,
        "duplicates": 0 if record is None else record.duplicates,
        "gaps": {} if record is None else record.gap_histogram,
        "resets": 0 if record is None else record.clock.restarts,
        "battery_percent": None if health is None else health.battery_percent,
        "temperature_celsius": None if health is None else health.temperature_celsius,
        "rssi_dbm": None if health is None else health.rssi_dbm,
        "unique_id": None if info is None else info.unique_id.hex(),
        "firmware": None if info is None else ".".join(map(str, info.firmware_version)),
    }


def _differs(state: ModuleState, before: ModuleState) -> bool:
    """Return whether there is anything new but the time of the message."""
    return state.model_copy(update={"t_ns": before.t_ns}) != before
