"""What sensors say: each packet declared once, with layout, unit and scale beside each field.

Everything is in SI units after decoding, in the sensor's own axes unless a field says otherwise;
a name carries its unit where it is not SI.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import radians
from typing import ClassVar

from firmware_protocol.fields import OPEN, flag, wire
from firmware_protocol.kinds import Kind

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

STANDARD_GRAVITY = 9.80665
"""m/s²: the g of data sheets."""
SENSORS = ("specific_force", "magnetic_field", "angular_rate")
"""Attributes of an inertial sample's sensors, in wire order."""
ACCELERATION, VELOCITY, POSITION = 1, 2, 3
"""Quantities of a local measurement."""


@dataclass(frozen=True, slots=True)
class _InertialReadings:
    """What both inertial samples hold; they differ in the elements on the wire alone."""

    specific_force: Vector3 | None = field(
        default=None,
        metadata=wire(
            OPEN,
            3,
            "m/s²",
            presence_bit=0,
            sentence="Specific force; at rest it reads 9.81 m/s² on the axis that points up.",
        ),
    )
    magnetic_field: Vector3 | None = field(
        default=None, metadata=wire(OPEN, 3, "µT", presence_bit=1, sentence="Magnetic field.")
    )
    angular_rate: Vector3 | None = field(
        default=None, metadata=wire(OPEN, 3, "rad/s", presence_bit=2, sentence="Angular rate.")
    )
    specific_force_clipped: bool = field(
        default=False,
        metadata=flag(4, "An axis of the accelerometer is at the end of its range.", clips="specific_force"),
    )
    magnetic_field_clipped: bool = field(
        default=False,
        metadata=flag(5, "An axis of the magnetometer is at the end of its range.", clips="magnetic_field"),
    )
    angular_rate_clipped: bool = field(
        default=False,
        metadata=flag(6, "An axis of the gyroscope is at the end of its range.", clips="angular_rate"),
    )
    triggered: bool = field(
        default=False,
        metadata=flag(7, "Sampled on a trigger of the host, not on the module's own timer."),
    )


@dataclass(frozen=True, slots=True)
class InertialSample(_InertialReadings):
    """One reading of a module's inertial sensors, for streaming."""

    KIND: ClassVar[int] = int(Kind.INERTIAL_SAMPLE)
    ELEMENTS: ClassVar[Mapping[str, tuple[str, float]]] = {
        "specific_force": ("h", 16 * STANDARD_GRAVITY / 2**15),
        "magnetic_field": ("h", 0.05),
        "angular_rate": ("h", radians(2000) / 2**15),
    }


@dataclass(frozen=True, slots=True)
class InertialSampleFine(_InertialReadings):
    """The same in finer steps, for laboratory modules and for recordings played without loss."""

    KIND: ClassVar[int] = int(Kind.INERTIAL_SAMPLE_FINE)
    ELEMENTS: ClassVar[Mapping[str, tuple[str, float]]] = {
        "specific_force": ("i", 1e-5),
        "magnetic_field": ("i", 1e-4),
        "angular_rate": ("i", 1e-6),
    }


@dataclass(frozen=True, slots=True)
class FusedSample:
    """Orientation fused on the module, and how far the module came since its last upload."""

    KIND: ClassVar[int] = int(Kind.FUSED_SAMPLE)

    orientation: Quaternion = field(
        metadata=wire(
            "h",
            4,
            "1",
            1 / (2**15 - 1),
            sentence="Unit quaternion w, x, y, z: sensor axes to the module's own level reference.",
        )
    )
    displacement: Vector3 = field(
        metadata=wire("i", 3, "m", 1e-6, sentence="Since the last upload, along the axes of that reference.")
    )
    interval: float = field(metadata=wire("I", 1, "s", 1e-6, sentence="Time that the displacement covers."))


@dataclass(frozen=True, slots=True)
class LocalMeasurement:
    """One reading of a local measuring device, in world axes (east, north, up)."""

    KIND: ClassVar[int] = int(Kind.LOCAL_MEASUREMENT)

    quantity: int = field(
        metadata=wire(
            "B",
            meanings={ACCELERATION: "acceleration, m/s²", VELOCITY: "velocity, m/s", POSITION: "position, m"},
            sentence="What is measured, and so the unit of the two fields that follow.",
        )
    )
    value: Vector3 = field(metadata=wire("f", 3, "as quantity", sentence="The measured vector."))
    sigma: Vector3 = field(
        metadata=wire("f", 3, "as quantity", minimum=0.0, sentence="Standard deviation of each component.")
    )


@dataclass(frozen=True, slots=True)
class LightSample:
    """One reading of the photoelectric cells on the six faces of a module."""

    KIND: ClassVar[int] = int(Kind.LIGHT_SAMPLE)

    intensity: tuple[float, float, float, float, float, float] = field(
        metadata=wire(
            "H",
            6,
            "full scale",
            1 / (2**16 - 1),
            sentence="Light on the faces +x, −x, +y, −y, +z, −z; at full scale the cell is saturated.",
        )
    )


@dataclass(frozen=True, slots=True)
class PressureSample:
    """One reading of a device with pressure tubes."""

    KIND: ClassVar[int] = int(Kind.PRESSURE_SAMPLE)

    differential_pressure: Vector3 = field(
        metadata=wire("f", 3, "Pa", sentence="Of the tubes along the device's x, y and z axes.")
    )
    static_pressure: float = field(metadata=wire("f", 1, "Pa", sentence="Pressure of the still air."))
    temperature_celsius: float | None = field(
        metadata=wire("h", 1, "°C", 0.01, absent=-(2**15), sentence="Temperature of the air.")
    )


@dataclass(frozen=True, slots=True)
class PassThrough:
    """What a receiver attached to a local measuring device said, unchanged."""

    KIND: ClassVar[int] = int(Kind.PASS_THROUGH)

    format: int = field(
        metadata=wire("B", meanings={1: "NMEA", 2: "UBX", 3: "UWB ranges"}, sentence="What the data are.")
    )
    data: bytes = field(metadata=wire("s", 0, min_size=1, max_size=240, sentence="The receiver's own bytes."))
