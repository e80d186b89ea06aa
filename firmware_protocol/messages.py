"""What modules say of themselves, and what they and the host say to one another."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import radians
from typing import ClassVar

from firmware_protocol.fields import wire
from firmware_protocol.kinds import Kind

UNIQUE_ID_SIZE = 12
ANYONE = bytes(UNIQUE_ID_SIZE)
"""Unique id of a command that is meant for whoever the header names."""

MAX_ARGUMENTS_SIZE = 200
MAX_PAYLOAD_SIZE = 200
MAX_PIECE_DATA_SIZE = 241
"""Fills a body on classic CAN."""

RESULTS = {
    0: "done",
    1: "unknown verb",
    2: "bad arguments",
    3: "refused: writes are locked on the device",
    4: "busy",
    5: "flash failed",
    6: "no such setting",
    7: "no such file",
    8: "nothing staged",
    9: "not supported by this device",
}
"""How a command ended."""

DEVICE_INFO_INTERVAL_S = 5.0
"""A device says who it is after a reset, and then so often."""


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Who a module is and what it carries. A sensor that is not there has no range and no rate."""

    KIND: ClassVar[int] = int(Kind.DEVICE_INFO)

    unique_id: bytes = field(
        metadata=wire("s", UNIQUE_ID_SIZE, sentence="Number of the chip, never the same twice.")
    )
    hardware_version: tuple[int, int] = field(metadata=wire("B", 2, sentence="Major, minor."))
    firmware_version: tuple[int, int, int] = field(metadata=wire("B", 3, sentence="Major, minor, patch."))
    accelerometer_range: float | None = field(
        metadata=wire("H", 1, "m/s²", 0.1, absent=0, sentence="Largest specific force of an axis.")
    )
    gyroscope_range: float | None = field(
        metadata=wire(
            "H",
            1,
            "rad/s",
            radians(1),
            absent=0,
            sentence="Largest angular rate of an axis; one step is 1°/s.",
        )
    )
    magnetometer_range: float | None = field(
        metadata=wire("H", 1, "µT", 1.0, absent=0, sentence="Largest magnetic field of an axis.")
    )
    accelerometer_sampling_rate: float | None = field(
        metadata=wire("H", 1, "Hz", 0.1, absent=0, sentence="Samples of the accelerometer each second.")
    )
    gyroscope_sampling_rate: float | None = field(
        metadata=wire("H", 1, "Hz", 0.1, absent=0, sentence="Samples of the gyroscope each second.")
    )
    magnetometer_sampling_rate: float | None = field(
        metadata=wire("H", 1, "Hz", 0.1, absent=0, sentence="Samples of the magnetometer each second.")
    )


@dataclass(frozen=True, slots=True)
class Health:
    """How a module fares. What a module cannot know has a reserved number. Counters wrap to 0."""

    KIND: ClassVar[int] = int(Kind.HEALTH)

    battery_percent: int | None = field(
        metadata=wire("B", 1, "%", absent=255, maximum=100, sentence="Charge left in the battery.")
    )
    battery_voltage: float | None = field(
        metadata=wire("H", 1, "V", 1e-3, absent=2**16 - 1, sentence="Voltage of the battery.")
    )
    temperature_celsius: float | None = field(
        metadata=wire("h", 1, "°C", 0.01, absent=-(2**15), sentence="Temperature of the inertial sensors.")
    )
    rssi_dbm: int | None = field(
        metadata=wire("b", 1, "dBm", absent=127, sentence="Strength of the radio signal received.")
    )
    uptime_s: int = field(metadata=wire("I", 1, "s", sentence="Time since the last reset."))
    samples_taken: int = field(metadata=wire("I", sentence="Samples taken since the last reset."))
    samples_dropped: int = field(
        metadata=wire("H", sentence="Samples taken that could not be sent since the last reset.")
    )
    sensor_errors: int = field(metadata=wire("H", sentence="Failed readings since the last reset."))
    resets: int = field(metadata=wire("H", sentence="Resets since the firmware was installed."))


@dataclass(frozen=True, slots=True)
class Event:
    """Something happened to a module, just now."""

    KIND: ClassVar[int] = int(Kind.EVENT)

    event: int = field(
        metadata=wire(
            "B",
            meanings={
                1: "button",
                2: "tap",
                3: "double tap",
                4: "shake",
                5: "charger connected",
                6: "charger removed",
                7: "settings committed",
                8: "started from the factory settings",
            },
            sentence="What happened.",
        )
    )
    value: int = field(
        default=0, metadata=wire("B", sentence="Which one, or how many times; 0 where neither applies.")
    )


@dataclass(frozen=True, slots=True)
class LogLine:
    """One line of a module's log."""

    KIND: ClassVar[int] = int(Kind.LOG_LINE)

    level: int = field(
        metadata=wire(
            "B", meanings={1: "error", 2: "warning", 3: "info", 4: "debug"}, sentence="How serious it is."
        )
    )
    text: str = field(
        metadata=wire("s", 0, is_text=True, max_size=200, sentence="UTF-8, not ended by a zero.")
    )


@dataclass(frozen=True, slots=True)
class SyncRequest:
    """Asks a module for its clock; the host measures how long the answer takes."""

    KIND: ClassVar[int] = int(Kind.SYNC_REQUEST)

    token: int = field(metadata=wire("H", sentence="Returned in the response."))
    host_time_us: int = field(metadata=wire("Q", 1, "µs", sentence="The host's clock when this was sent."))


@dataclass(frozen=True, slots=True)
class SyncResponse:
    """The module's clock when a request came and when this was sent."""

    KIND: ClassVar[int] = int(Kind.SYNC_RESPONSE)

    token: int = field(metadata=wire("H", sentence="That of the request."))
    received_us: int = field(
        metadata=wire("I", 1, "µs", sentence="The module's clock when the request came, wraps to 0.")
    )
    sent_us: int = field(
        metadata=wire("I", 1, "µs", sentence="The module's clock when this was sent, wraps to 0.")
    )


@dataclass(frozen=True, slots=True)
class SamplingTrigger:
    """Sample now. The sample is marked as triggered, and its sequence number is this number."""

    KIND: ClassVar[int] = int(Kind.SAMPLING_TRIGGER)

    number: int = field(metadata=wire("H", sentence="Counts triggers, wraps to 0."))


@dataclass(frozen=True, slots=True)
class Command:
    """The host asks a module to do something; verbs are listed under "Commands"."""

    KIND: ClassVar[int] = int(Kind.COMMAND)

    transaction: int = field(metadata=wire("H", sentence="The same when a command is repeated."))
    verb: int = field(metadata=wire("B", sentence="What to do."))
    unique_id: bytes = field(
        default=ANYONE,
        metadata=wire(
            "s",
            UNIQUE_ID_SIZE,
            sentence="Only the device of this number acts, whatever its id. "
            "All zeros: whoever the header names.",
        ),
    )
    arguments: bytes = field(
        default=b"", metadata=wire("s", 0, max_size=MAX_ARGUMENTS_SIZE, sentence="As the verb declares.")
    )


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """A module's answer to a command."""

    KIND: ClassVar[int] = int(Kind.ACKNOWLEDGEMENT)

    transaction: int = field(metadata=wire("H", sentence="That of the command."))
    verb: int = field(metadata=wire("B", sentence="That of the command."))
    result: int = field(metadata=wire("B", meanings=RESULTS, sentence="How it ended."))
    unique_id: bytes = field(metadata=wire("s", UNIQUE_ID_SIZE, sentence="Number of the chip that answers."))
    payload: bytes = field(
        default=b"",
        metadata=wire(
            "s", 0, max_size=MAX_PAYLOAD_SIZE, sentence="As the verb declares; empty unless the result is 0."
        ),
    )


@dataclass(frozen=True, slots=True)
class _TransferPiece:
    """One piece of a wire frame too long for one set of CAN frames; see "Long wire frames on CAN"."""

    piece: int = field(
        metadata=wire("B", meanings={1: "first", 2: "consecutive", 3: "flow control"}, sentence="What it is.")
    )
    transfer: int = field(metadata=wire("B", sentence="Counts the sender's transfers, wraps to 0."))
    number: int = field(
        metadata=wire(
            "H",
            sentence="First: bytes of the whole. Consecutive: its place, from 1. Flow control: place of the "
            "piece wanted next.",
        )
    )
    data: bytes = field(
        default=b"",
        metadata=wire(
            "s",
            0,
            max_size=MAX_PIECE_DATA_SIZE,
            sentence="Bytes of the whole; in flow control, what it asks.",
        ),
    )


@dataclass(frozen=True, slots=True)
class TransferToModule(_TransferPiece):
    """A piece from the host: of its own long wire frame, or flow control for a module's."""

    KIND: ClassVar[int] = int(Kind.TRANSFER_TO_MODULE)


@dataclass(frozen=True, slots=True)
class TransferToHost(_TransferPiece):
    """A piece from a module: of its own long wire frame, or flow control for the host's."""

    KIND: ClassVar[int] = int(Kind.TRANSFER_TO_HOST)
