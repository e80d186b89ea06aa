"""Every value that flows, in the order it flows.

``Chunk`` (``devices.link``: bytes and when they arrived) → ``WireFrame`` (``firmware_protocol.framing``)
→ packets (``firmware_protocol.packets``) → ``InertialBatch`` / ``FusedReading`` / ``LocalReading`` (one
module, one instant, gateway time) → ``ImuFrame`` (all modules, one instant) → ``SkeletonFrame``. An optical
system's chunks become ``MarkerFrame`` → ``SkeletonFrame``, those of cameras ``HeatMapFrame`` →
``SkeletonFrame``.

SI units throughout: m, s, rad, m/s², rad/s; magnetic field in µT. Instants are integer nanoseconds
of gateway time. Quaternions are unit, Hamilton, (w, x, y, z); ``q_ab`` takes coordinates in b to
coordinates in a. Letters: w world (ENU), s sensor, b body segment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
StatusArray = NDArray[np.uint8]
Vector3 = tuple[float, float, float]


class Status(IntEnum):
    """Where a value of one instant came from, best first."""

    MEASURED = 0
    """Between two successive samples of the module: nothing was lost around this instant."""
    INTERPOLATED = 1
    """Bridged over lost samples, within the configured longest gap."""
    HELD = 2
    """The last sample, repeated: nothing newer came in time."""
    PREDICTED = 3
    """From a model, without any sample."""
    WARMING_UP = 4
    """Samples come, but the method cannot define this value yet."""
    MISSING = 5
    """No sample to stand on."""
    UNAIDED = 6
    """Measured by its gyroscopes, but what told inclination is gone: all local devices of its chain are
    silent, or its own accelerometer is saturated. (Numbers never change, hence here.)"""
    DOUBTFUL = 7
    """Measured, but its module is not worn as the rig says, as far as the motion tells, or begins its clock
    anew again and again."""


class Clipped(IntFlag):
    """Sensors of a module that were at the end of their range: what they felt was at least that much."""

    SPECIFIC_FORCE = 1
    ANGULAR_RATE = 2


INERTIAL_SAMPLE = np.dtype(
    [
        ("module", np.int64),
        ("sequence", np.int64),  # unwrapped sample count of the module
        ("time_ns", np.int64),  # gateway time at which the module sampled, by its clock model
        ("measured", np.float64, (3, 3)),  # a row a sensor, its own axes; NaN: it was not read
        ("clipped", np.uint8),  # ``Clipped`` sensors
    ],
    align=True,
)
"""One sample of one module; ``measured`` by ``SPECIFIC_FORCE``, ``ANGULAR_RATE``, ``MAGNETIC_FIELD``."""
SPECIFIC_FORCE, ANGULAR_RATE, MAGNETIC_FIELD = range(3)
"""m/s², rad/s, µT."""
NOT_READ = (float("nan"),) * 3


class Sample(NamedTuple):
    """A row of a batch, with the fields of ``INERTIAL_SAMPLE`` in their order."""

    module: int
    sequence: int
    time_ns: int
    measured: tuple[Vector3, Vector3, Vector3]
    clipped: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class InertialBatch:
    """Samples of modules in order of arrival."""

    samples: NDArray[np.void]  # (n,) INERTIAL_SAMPLE

    @classmethod
    def of(cls, rows: Sequence[Sample]) -> InertialBatch:
        """Return a batch of samples."""
        return cls(np.array(rows, INERTIAL_SAMPLE))

    def __len__(self) -> int:
        return len(self.samples)


@dataclass(frozen=True, slots=True)
class FusedReading:
    """What one module has fused on board for one instant."""

    module: int
    sequence: int
    """Unwrapped sample count of the module."""
    time_ns: int
    """Gateway time of the orientation, by the module's clock model."""
    orientation: tuple[float, float, float, float]
    """``q_es``: sensor axes to the module's own level reference e."""


class Quantity(IntEnum):
    """What a local measuring device (ML) measures, in world axes unless said otherwise."""

    FIXED_POINT = 0
    ACCELERATION = 1
    VELOCITY = 2
    POSITION = 3
    AIR_VELOCITY = 4
    """Velocity in still air by pressure tubes, in the axes of the segment that carries them."""


@dataclass(frozen=True, slots=True)
class LocalReading:
    """One reading of a local measuring device, in the axes that its quantity has."""

    device: int
    time_ns: int
    quantity: Quantity
    value: FloatArray  # (3,) m/s², m/s or m
    sigma: FloatArray  # (3,) standard deviation, same unit


@dataclass(frozen=True, slots=True)
class LightReading:
    """One reading of a module's photoelectric cells."""

    module: int
    time_ns: int
    intensity: FloatArray  # (6,) share of full scale, cells in the order of the wire


Reading = InertialBatch | FusedReading | LocalReading | LightReading
"""Of modules, or of a local device."""


@dataclass(frozen=True, slots=True)
class SunSight:
    """Where the modules see the sun; the second uniform field beside the earth's, or in the place of it."""

    world: FloatArray  # (3,) unit, ENU, by the almanac
    direction: FloatArray  # (n_modules, 3) unit, sensor axes; NaN where it is not seen
    sigma: FloatArray  # (n_modules,) rad, of each component across it; NaN likewise


@dataclass(frozen=True, slots=True)
class ImuFrame:
    """All modules at one instant, each in its own sensor axes, in the order of the rig.

    A module without a value has NaN rows; so has a sensor that the module does not carry.
    """

    sequence: int
    time_ns: int
    specific_force: FloatArray  # (n_modules, 3) m/s²
    angular_rate: FloatArray  # (n_modules, 3) rad/s
    magnetic_field: FloatArray  # (n_modules, 3) µT
    status: StatusArray  # (n_modules,) Status
    gap_ns: IntArray  # (n_modules,) time between the samples this value rests on (held: its age)
    local: tuple[LocalReading, ...] = field(default=())
    """Readings of local measuring devices since the frame before, in time order."""
    orientation: FloatArray | None = None
    """(n_modules, 4) ``q_es`` fused on the modules, each to its own level reference e; None: they send raw
    values."""
    light: tuple[LightReading, ...] = field(default=())
    """Readings of photoelectric cells since the frame before, in time order."""
    sun: SunSight | None = None
    """What they show; None: the suit has no cells in use."""
    clipped: StatusArray | None = None
    """(n_modules,) ``Clipped`` sensors of what this instant rests on; None: none of any."""


@dataclass(frozen=True, slots=True)
class MarkerFrame:
    """All markers of an optical system at one instant, world axes, in the order of the fitted body."""

    sequence: int
    time_ns: int
    positions: FloatArray  # (n_markers, 3) m; NaN: not seen
    unlabelled: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3) m
    """Points that the optical system saw and could not name."""


@dataclass(frozen=True, slots=True)
class MarkerFit:
    """How a pose explains the markers of its instant: world axes, in the order of the fitted body."""

    positions: FloatArray
    """(M, 3) m, after names were put right; NaN: not seen."""
    virtual: FloatArray
    """(M, 3) m: where the body has its markers."""
    residuals: FloatArray
    """(M,) m; NaN where not seen. Points that had no say, ghosts among them, have one too."""
    used: NDArray[np.bool_]
    """(M,) had a say."""
    renamed: tuple[tuple[int, int], ...] = ()
    """(marker, whose point it had been; -1 for a nameless one)."""
    unlabelled: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) m, points that the optical system could not name, those among them that were given one here."""

    @property
    def rmse(self) -> float:
        """m, of the markers used; NaN with none."""
        chosen = self.residuals[self.used]
        return float(np.sqrt(np.mean(chosen**2))) if len(chosen) else float("nan")


@dataclass(frozen=True, slots=True)
class CameraHeatMaps:
    """The part confidence maps (PCM) of one person in one picture: how likely a keypoint is at each place."""

    likelihood: NDArray[np.float32]  # (n_keypoints, rows, columns), 0 to 1
    map_from_pixel: FloatArray  # (2, 3) affine: pixel (x, y, 1) of the distorted picture to (column, row)
    """A crop that was turned and shrunk is a turned and shrunk affine."""


@dataclass(frozen=True, slots=True)
class HeatMapFrame:
    """What the pose networks of all cameras show at one instant."""

    sequence: int
    time_ns: int
    cameras: tuple[CameraHeatMaps | None, ...]
    """In the order of the calibrated cameras; None for one that has no picture of the person."""


Observation = Reading | MarkerFrame | HeatMapFrame
"""What sources give, in gateway time."""


@dataclass(frozen=True, slots=True)
class SkeletonFrame:
    """What every reconstructor yields, whatever it observed. NaN where a value is not defined."""

    sequence: int
    time_ns: int
    q_wb: FloatArray  # (n_segments, 4) segment to world, w >= 0
    angular_rate: FloatArray  # (n_segments, 3) rad/s, segment axes
    joint_acceleration: FloatArray  # (n_segments, 3) m/s², proximal joint, world axes, without gravity
    p_w: FloatArray  # (n_segments, 3) m, proximal joint
    sigma: FloatArray  # (n_segments,) rad, standard deviation of the orientation; NaN: not estimated
    status: StatusArray  # (n_segments,) Status
    root: int
    """Index of the rank-1 segment."""
    markers: MarkerFit | None = None
    """Of a pose made from markers: what became of each."""


def unknown_pose(n_segments: int, sequence: int = 0, time_ns: int = 0) -> SkeletonFrame:
    """Return a pose of which nothing is known: all NaN, every segment MISSING."""
    q_wb, rate, acceleration, p_w = (np.full((n_segments, size), np.nan) for size in (4, 3, 3, 3))
    status = np.full(n_segments, Status.MISSING, np.uint8)
    sigma = np.full(n_segments, np.nan)
    return SkeletonFrame(sequence, time_ns, q_wb, rate, acceleration, p_w, sigma, status, 0)
