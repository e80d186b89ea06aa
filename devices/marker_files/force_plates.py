"""Force plates of a C3D file: what the floor gave, in the axes of the file.

After the C3D file format user guide (Motion Lab Systems, 2021), chapters "Analog data" and "Force plates".
Types 1 to 4 are read. Whatever way a plate's channels count (the person's push or the floor's answer) and
whichever way round its corners are listed (its z down, as the guide has it, or up), the result is what the
floor does to the person, since a plate can only push upwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.marker_files.c3d import C3DFile, metres_per_unit, open_c3d
from devices.marker_files.trial import FloatArray
from devices.vendor_formats.sheets import FormatError

CHANNELS = {1: 6, 2: 6, 3: 8, 4: 6}
"""By type of plate."""
_LEAST_FORCE_N = 10.0
"""Below it a centre of pressure is noise."""
_LEAST_SURFACE_M2 = 1e-4
"""Four times a plate's."""


@dataclass(frozen=True)
class ForcePlate:
    """N analog samples of one plate; axes of the file, SI units."""

    corners: FloatArray  # (4, 3) m, in the order of the file: x+y+, x-y+, x-y-, x+y- of the plate
    force: FloatArray  # (N, 3) N, on the person
    moment: FloatArray  # (N, 3) N m, on the person, about ``centre``

    @property
    def centre(self) -> FloatArray:
        """(3,) m, middle of the surface."""
        middle: FloatArray = self.corners.mean(axis=0)
        return middle

    def centre_of_pressure(self) -> FloatArray:
        """Return the centre of pressure (N, 3), m, on the surface; NaN where there is hardly any force."""
        normal = np.cross(self.corners[0] - self.corners[2], self.corners[1] - self.corners[3])
        normal /= np.linalg.norm(normal)
        through = self.force @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            arm = np.cross(normal, self.moment) / through[:, None]
        arm[np.abs(through) < _LEAST_FORCE_N] = np.nan
        pressure: FloatArray = self.centre + arm
        return pressure


@dataclass(frozen=True)
class ForcePlates:
    """All plates of a trial."""

    rate_hz: float
    plates: tuple[ForcePlate, ...]
    begins_s: float = 0.0
    """Time of the first sample, by the file's own count."""


def read_force_plates(path: Path) -> ForcePlates:
    """Read the plates of a file, possibly none. Raises ``FormatError`` for one that cannot be read."""
    file = open_c3d(path)
    count = int(file.number("FORCE_PLATFORM:USED", 0))
    channels = int(file.number("ANALOG:USED", 0))
    if count == 0 or channels == 0 or file.layout.analog_per_frame == 0:
        return ForcePlates(file.rate_hz, ())
    # Analog values come several times a frame, all channels each time.
    if file.layout.analog_per_frame % channels:
        raise FormatError(
            f"{path}: {file.layout.analog_per_frame} analog values a frame do not go with ANALOG:USED "
            f"{channels}"
        )
    analog = _analog(file, channels)
    rate_hz = file.rate_hz * file.layout.analog_per_frame / channels
    plates = tuple(_plate(file, index, count, analog) for index in range(count))
    return ForcePlates(rate_hz, plates, file.begins_s)


def _analog(file: C3DFile, channels: int) -> FloatArray:
    """Return analog values (N, channels) in the units of the file."""
    stored = file.rows()[:, 4 * file.layout.n_points :].reshape(-1, channels)
    texts = file.parameters["ANALOG:FORMAT"].texts() if "ANALOG:FORMAT" in file.parameters else []
    is_unsigned = bool(texts) and texts[0].upper().startswith("UNSIGNED")
    if is_unsigned and file.layout.scale > 0:
        stored = np.where(stored < 0, stored + 65536.0, stored)
    offset = _each(file, "ANALOG:OFFSET", channels, 0.0)
    # Offsets are read as unsigned; in a file of signed values those above 32767 are negative.
    if not is_unsigned:
        offset = np.where(offset > 32767, offset - 65536.0, offset)
    scale = _each(file, "ANALOG:SCALE", channels, 1.0) * file.number("ANALOG:GEN_SCALE", 1.0)
    return (stored - offset) * scale


def _each(file: C3DFile, name: str, count: int, default: float) -> FloatArray:
    found = file.parameters[name].numbers()[:count] if name in file.parameters else np.zeros(0)
    return np.concatenate([found, np.full(count - len(found), default)])


def _plate(file: C3DFile, index: int, count: int, analog: FloatArray) -> ForcePlate:
    where = f"{file.path}: force plate {index + 1}"
    kind = int(_table(file, "TYPE", (count,), where)[index])
    if kind not in CHANNELS:
        raise FormatError(
            f"{where} is of type {kind}: types {', '.join(map(str, CHANNELS))} are read (`analyse --forces "
            "none` does without plates)"
        )
    per_unit = metres_per_unit(file.parameters, file.path)
    corners = _table(file, "CORNERS", (count, 4, 3), where)[index] * per_unit
    origin = _table(file, "ORIGIN", (count, 3), where)[index] * per_unit
    wired = _wired(file, index, count, where)[: CHANNELS[kind]].astype(np.int64)
    if len(wired) < CHANNELS[kind] or wired.min() < 1 or wired.max() > analog.shape[1]:
        raise FormatError(
            f"{where}: FORCE_PLATFORM:CHANNEL names {wired.tolist()}, {CHANNELS[kind]} of the "
            f"{analog.shape[1]} analog channels are wanted"
        )
    signals = _without_offset(file, analog[:, wired - 1])
    if kind == 4:
        matrix = _table(file, "CAL_MATRIX", (count, 6, 6), where)[index].T  # columns are stored first
        signals = signals @ matrix.T
    axes = _axes(corners, where)
    down = -_points_up(axes[:, 2])
    return _on_person(corners, axes, down, *_at_surface(kind, signals, origin, per_unit, down))


def _without_offset(file: C3DFile, signals: FloatArray) -> FloatArray:
    """Subtract the mean over the frames in which, by FORCE_PLATFORM:ZERO, nobody stands on the plate."""
    parameter = file.parameters.get("FORCE_PLATFORM:ZERO")
    zero = parameter.numbers() if parameter is not None else np.zeros(0)
    if len(zero) < 2 or zero[0] < 1 or zero[1] < zero[0]:
        return signals
    per_frame = len(signals) // file.layout.n_frames
    unloaded = signals[int(zero[0] - 1) * per_frame : int(zero[1]) * per_frame]
    return signals - unloaded.mean(axis=0) if len(unloaded) else signals


def _at_surface(
    kind: int, signals: FloatArray, origin: FloatArray, per_unit: float, down: float
) -> tuple[FloatArray, FloatArray]:
    """Return force (N, 3) N and moment (N, 3) N m about the middle of the surface, in the plate's axes.

    down: 1 where the plate's z points down, -1 where it points up.
    """
    zero = np.zeros(len(signals))
    if kind == 1:  # force, where it goes through the surface, free moment
        force, torsion = signals[:, :3], signals[:, 5] * per_unit
        at = np.stack([signals[:, 3] * per_unit, signals[:, 4] * per_unit, zero], axis=1)
        return force, np.cross(at, force) + np.stack([zero, zero, torsion], axis=1)
    if kind == 3:  # four three-component sensors at (±a, ±b); origin holds a, b and their depth
        x12, x34, y14, y23, z1, z2, z3, z4 = signals.T
        a, b, depth = np.abs(origin[0]), np.abs(origin[1]), origin[2]
        force = np.stack([x12 + x34, y14 + y23, z1 + z2 + z3 + z4], axis=1)
        moment = np.stack(
            [b * (z1 + z2 - z3 - z4), a * (-z1 + z2 + z3 - z4), b * (-x12 + x34) + a * (y14 - y23)], axis=1
        )
        arm = np.array([0.0, 0.0, -down * abs(depth)])
    else:
        force, moment = signals[:, :3], signals[:, 3:6] * per_unit
        # the surface lies over the sensors: some files have it upside down
        arm = origin if down * origin[2] <= 0 else -origin
    return force, moment - np.cross(arm, force)


def _axes(corners: FloatArray, where: str) -> FloatArray:
    """Return the plate's axes (3, 3): x and y along its sides, z across.

    Raises ``FormatError`` for corners that make no surface.
    """
    x = corners[0] + corners[3] - corners[1] - corners[2]
    y = corners[0] + corners[1] - corners[2] - corners[3]
    z = np.cross(x, y)
    if not np.linalg.norm(z) > _LEAST_SURFACE_M2:
        listed = "; ".join(" ".join(f"{value:g}" for value in corner) for corner in corners)
        raise FormatError(f"{where}: FORCE_PLATFORM:CORNERS make no rectangle ({listed} m): correct the file")
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    # Corners are measured and no exact rectangle: y is made square to x.
    return np.stack([x, np.cross(z, x), z], axis=1)


def _points_up(z: FloatArray) -> float:
    """Return 1 for an axis that points along the positive axis of the file nearest to it, else -1."""
    return 1.0 if z[np.argmax(np.abs(z))] > 0 else -1.0


def _on_person(
    corners: FloatArray, axes: FloatArray, down: float, force: FloatArray, moment: FloatArray
) -> ForcePlate:
    """Turn values from the plate's axes to those of the file, with the sign that pushes upwards."""
    pushed = force[:, 2] if len(force) else np.zeros(1)
    # Files give either the force on the plate or that on the person: the floor can only push.
    sign = -1.0 if down * pushed[np.argmax(np.abs(pushed))] > 0 else 1.0
    return ForcePlate(corners, sign * force @ axes.T, sign * moment @ axes.T)


def _wired(file: C3DFile, index: int, count: int, where: str) -> FloatArray:
    parameter = file.parameters.get("FORCE_PLATFORM:CHANNEL")
    numbers = parameter.numbers() if parameter is not None else np.zeros(0)
    if len(numbers) % count or not len(numbers):
        raise FormatError(f"{where}: FORCE_PLATFORM:CHANNEL holds {len(numbers)} numbers for {count} plates")
    wired: FloatArray = numbers.reshape(count, -1)[index]
    return wired


def _table(file: C3DFile, name: str, shape: tuple[int, ...], where: str) -> FloatArray:
    """Return a parameter of all plates, the last dimension of the file first."""
    parameter = file.parameters.get(f"FORCE_PLATFORM:{name}")
    numbers = parameter.numbers() if parameter is not None else np.zeros(0)
    if len(numbers) < np.prod(shape):
        raise FormatError(
            f"{where}: FORCE_PLATFORM:{name} holds {len(numbers)} numbers, {int(np.prod(shape))} are wanted"
        )
    table: FloatArray = numbers[: int(np.prod(shape))].reshape(shape)
    return table
