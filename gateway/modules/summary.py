"""What is told of each module in a list."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from devices.roster import Conflict, Device, Roster
from firmware_protocol.kinds import Kind
from gateway.body.skeleton import WornSuit
from gateway.contract.messages import ModuleClockState
from gateway.sources.statistics import ModuleRecord
from gateway.sources.stream import Stream

SAMPLE_KINDS = (
    Kind.INERTIAL_SAMPLE,
    Kind.INERTIAL_SAMPLE_FINE,
    Kind.FUSED_SAMPLE,
    Kind.LOCAL_MEASUREMENT,
    Kind.PRESSURE_SAMPLE,
)
"""Kinds that a rate is told of."""


class _Plain(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ModuleSummary(_Plain):
    """One device that answered, or is only heard sending."""

    module: int = Field(description="module id; 254 is the relay")
    answers: bool = Field(description="false: it sends, but does not answer commands")
    unique_id: str | None = Field(description="none: it has neither answered nor said who it is")
    segment: str | None = Field(description="by the rig; none: the rig has no module of this id")
    link: str | None = None
    firmware: str | None = None
    protocol: int | None = Field(default=None, description="version spoken; none: none in common")
    battery_percent: int | None = None
    rate_hz: float = Field(description="samples a second, measured")
    loss_percent: float | None = Field(description="packets lost since the link is read")
    clock: ModuleClockState | None = Field(default=None, description="none: never heard sending")
    resets: int = Field(default=0, description="how often it was found to count from anew")
    gaps: dict[str, int] = Field(default={}, description="how often so many packets were lost in a row")


class ConflictSummary(_Plain):
    """A module id that several devices have."""

    module: int
    unique_ids: tuple[str, ...]


class ModuleList(_Plain):
    """Who is there."""

    modules: tuple[ModuleSummary, ...]
    conflicts: tuple[ConflictSummary, ...]
    segments: dict[str, int] = Field(description="module id that the rig gives to each segment")


class Counts(NamedTuple):
    """Sample counts at one moment, for rates."""

    time_ns: int
    samples: dict[int, int]


def segments_of(suit: WornSuit) -> dict[str, int]:
    """Module id by segment, for the segments that wear one."""
    worn = zip(suit.skeleton.segment_names, suit.module_of_segment.tolist(), strict=True)
    return {name: suit.module_ids[row] for name, row in worn if row >= 0}


def module_names(suit: WornSuit) -> dict[int, str]:
    """What each module or local device of the rig is on, by id."""
    return {module: segment for segment, module in segments_of(suit).items()} | local_devices_of(suit)


def local_devices_of(suit: WornSuit) -> dict[int, str]:
    """What to call the local measuring devices, by id."""
    return {
        local.device: f"{suit.skeleton.segment_names[local.segment]} ({local.quantity.name.lower()})"
        for local in suit.local_devices
        if local.device is not None
    }


def count_samples(stream: Stream, time_ns: int) -> Counts:
    """Samples received so far, by module id."""
    return Counts(
        time_ns, {module: count_module_samples(record) for module, record in stream.modules.items()}
    )


def summarise(roster: Roster, stream: Stream, suit: WornSuit, before: Counts, after: Counts) -> ModuleList:
    """The list of a roster, with rates between two counts."""
    segments = segments_of(suit)
    names = module_names(suit)
    span_s = max((after.time_ns - before.time_ns) * 1e-9, 1e-9)
    rates = {
        module: (count - before.samples.get(module, 0)) / span_s for module, count in after.samples.items()
    }
    answering = [
        _summary(device.module, device, stream.modules.get(device.module), names, rates)
        for device in roster.devices
    ]
    known = {device.module for device in roster.devices}
    silent = [
        _summary(module, None, record, names, rates)
        for module, record in sorted(stream.modules.items())
        if module not in known and rates.get(module)
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
        rate_hz=round(rates.get(module, 0.0), 1),
        loss_percent=_loss_percent(record),
        clock=None if record is None else clock_state(record),
        resets=0 if record is None else record.clock.restarts,
        gaps={} if record is None else record.gap_histogram,
    )


def _conflict(conflict: Conflict) -> ConflictSummary:
    return ConflictSummary(
        module=conflict.module, unique_ids=tuple(unique_id.hex() for unique_id in conflict.unique_ids)
    )


def count_module_samples(record: ModuleRecord) -> int:
    """Samples received of one module."""
    return sum(record.sequences[kind].received for kind in SAMPLE_KINDS if kind in record.sequences)


def clock_state(record: ModuleRecord) -> ModuleClockState:
    """A module's clock as published."""
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
