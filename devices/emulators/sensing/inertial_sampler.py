"""The samples of all inertial modules: true motion → imperfect readings → bodies, many at once.

``ImperfectSensors`` are those of one module; ``FusedOutput`` is a module that fuses on board: orientation and
displacement as it would have estimated them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from devices.deferred import Rotation
from devices.emulators.bodies import FloatArray
from devices.emulators.device.sampling import FUSED, Sampling
from devices.emulators.device.sender import Timed
from devices.emulators.imperfections import Imperfections, ModuleErrors, module_random
from devices.emulators.sensing.disturbances import Disturbance, felt
from devices.emulators.sensing.ideal_sensors import Sensed, SensedMotion, Wanted
from devices.emulators.sensing.light_sampler import LightSampler, Sunlight
from devices.emulators.sensing.sample_encoding import SampleEncoder
from firmware_protocol import FusedSample
from firmware_protocol.device_settings import factory_settings
from firmware_protocol.fields import BYTE_ORDER, INTEGER_RANGE, layout_of
from firmware_protocol.samples import SENSORS

_NOISE_RATE_HZ = 100.0  # at which the settings state the noise
_PURPOSE = 11
_NO_NOISE = np.zeros(4)
_CALIBRATION_KEY = 9
_NO_CALIBRATION = tuple(factory_settings()[_CALIBRATION_KEY])


class ImperfectSensors:
    """Distorts, biases and adds noise. The stream of noise does not depend on how it is cut into blocks."""

    def __init__(self, settings: Imperfections, errors: ModuleErrors, seed: int, module: int) -> None:
        self._noise = np.array(
            [settings.accelerometer_noise, settings.gyroscope_noise, settings.magnetometer_noise]
        )
        self._walk = settings.gyroscope_bias_walk
        self._is_noisy = bool(self._noise.any() or self._walk)
        self._errors = errors
        self._rng = module_random(seed, module, _PURPOSE)
        self.gyroscope_bias = errors.gyroscope_bias.copy()
        """(3,) rad/s, as of the last reading."""

    def read(
        self,
        specific_force: FloatArray,
        angular_rate: FloatArray,
        magnetic_field: FloatArray,
        sampling_rate_hz: float,
    ) -> dict[str, FloatArray]:
        """Return readings (n, 3) by the name of the sensor, from true values (n, 3), in sensor axes."""
        errors, n = self._errors, len(specific_force)
        noise = _NO_NOISE
        gyroscope_bias = self.gyroscope_bias
        sigma = self._noise * math.sqrt(sampling_rate_hz / _NOISE_RATE_HZ)
        if self._is_noisy and n:
            noise = self._rng.standard_normal((n, 4, 3)).transpose(1, 0, 2)
            # The bias wanders from sample to sample, and goes on from there with the next call.
            walk = self._walk / math.sqrt(sampling_rate_hz)
            gyroscope_bias = self.gyroscope_bias + walk * noise[3].cumsum(axis=0)
            self.gyroscope_bias = gyroscope_bias[-1]
        return {
            "specific_force": specific_force @ errors.accelerometer_distortion.T
            + (errors.accelerometer_bias + sigma[0] * noise[0]),
            "angular_rate": angular_rate @ errors.gyroscope_distortion.T
            + (gyroscope_bias + sigma[1] * noise[1]),
            "magnetic_field": magnetic_field @ errors.magnetometer_distortion.T
            + (errors.magnetometer_bias + sigma[2] * noise[2]),
        }


def calibrated(readings: dict[str, FloatArray], calibration: tuple[float, ...]) -> dict[str, FloatArray]:
    """Return readings (n, 3) by sensor, corrected by the setting ``calibration`` (30 numbers).

    Accelerometer ``A (f − b)``, gyroscope ``ω − b``, magnetometer ``S (m − h)``.
    """
    if calibration == _NO_CALIBRATION:
        return readings
    c = np.asarray(calibration)
    return {
        "specific_force": (readings["specific_force"] - c[9:12]) @ c[:9].reshape(3, 3).T,
        "angular_rate": readings["angular_rate"] - c[12:15],
        "magnetic_field": (readings["magnetic_field"] - c[24:27]) @ c[15:24].reshape(3, 3).T,
    }


_FUSED_PURPOSE = 13

_FIELDS = {declared.name: declared for declared in layout_of(FusedSample).fields}
_DTYPE = np.dtype(
    [
        (name, BYTE_ORDER + declared.code, (declared.count,) if declared.count > 1 else ())
        for name, declared in _FIELDS.items()
    ]
)


class FusedOutput:
    """The fused samples of one module, encoded.

    Its level reference ``e`` is level exactly and turned against the world by a heading that stays.
    """

    def __init__(self, settings: Imperfections, seed: int, module: int) -> None:
        self._rng = module_random(seed, module, _FUSED_PURPOSE)
        heading = self._rng.uniform(-np.pi, np.pi)
        self.heading = heading if settings.has_random_heading else 0.0
        """Angle about the vertical that takes the world's axes to those of the reference, rad."""
        self._R_ew = Rotation.from_euler("z", -self.heading).as_matrix()
        self._settings = settings
        self._last: tuple[float, FloatArray] | None = None
        self._stream = 0

    def encode(self, instants: FloatArray, sensed: Sensed, stream: int) -> list[bytes]:
        """Return one body a sample, at instants (n,) of the module's clock, n > 0, s.

        The first upload of another stream covers no time.
        """
        if stream != self._stream:
            self._stream, self._last = stream, None
        noise = self._rng.standard_normal((len(instants), 6))
        interval, displacement = self._since_last(instants, sensed.position)
        error = Rotation.from_rotvec(self._settings.fused_orientation * noise[:, :3])
        orientation = Rotation.from_matrix(self._R_ew @ sensed.R_ws) * error

        rows = np.zeros(len(instants), _DTYPE)
        displacement = displacement + self._settings.fused_displacement * noise[:, 3:]
        for name, values in (
            ("orientation", orientation.as_quat(canonical=True, scalar_first=True)),
            # An upload that covers no time has no displacement, not even noise.
            ("displacement", displacement * (interval > 0.0)[:, None]),
            ("interval", interval),
        ):
            declared = _FIELDS[name]
            low, high = INTEGER_RANGE[declared.code]
            rows[name] = np.clip(np.rint(values / (declared.scale or 1.0)), low, high)
        packed, size = rows.tobytes(), _DTYPE.itemsize
        return [packed[start : start + size] for start in range(0, len(packed), size)]

    def _since_last(self, instants: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the time (n,) and way (n, 3) from one upload to the next, along the axes of the
        reference."""
        last_s, last_position = self._last or (float(instants[0]), position[0])
        self._last = float(instants[-1]), position[-1]
        way = np.diff(position, axis=0, prepend=last_position[None])
        return np.diff(instants, prepend=last_s), way @ self._R_ew.T


class InertialSampler:
    """What the modules of a suit read and send when they sample."""

    def __init__(
        self,
        motion: SensedMotion,
        encoder: SampleEncoder,
        imperfections: Imperfections,
        errors: Mapping[int, ModuleErrors],
        seed: int,
        disturbances: Mapping[int, Sequence[Disturbance]],
        sunlight: Sunlight | None = None,
    ) -> None:
        """Build the sensors of all inertial modules.

        motion: its columns are the modules in the order of ``errors``.
        errors, disturbances: by number of the device.
        sunlight: what their photoelectric cells see; None: they have none.
        """
        self._motion = motion
        self._encoder = encoder
        self._disturbances = disturbances
        self._column = {number: column for column, number in enumerate(errors)}
        self._sensors = {
            number: ImperfectSensors(imperfections, drawn, seed, number) for number, drawn in errors.items()
        }
        self._light = (
            {} if sunlight is None else {number: LightSampler(sunlight, seed, number) for number in errors}
        )
        self.fused = {number: FusedOutput(imperfections, seed, number) for number in errors}
        """What modules that fuse on board send, by number of the device."""

    def prepare(self, planned: Mapping[int, FloatArray]) -> None:
        """Evaluate the motion ahead, at true times (n,) by number of the device."""
        self._motion.prepare(
            [Wanted(self._column[number], times) for number, times in planned.items() if len(times)]
        )

    def is_prepared(self, sampling: Sampling) -> bool:
        """Return whether the instants of a sampling were foreseen."""
        return self._motion.has(self._wanted(sampling))

    def sample(self, samplings: Sequence[Sampling]) -> list[list[Timed]]:
        """Return the wire frames of each sampling."""
        sensed = self._motion.at([self._wanted(sampling) for sampling in samplings])
        bodies: list[tuple[int, list[bytes]]] = [(FusedSample.KIND, [])] * len(samplings)
        raw: list[int] = []
        for place, (sampling, at) in enumerate(zip(samplings, sensed, strict=True)):
            if sampling.settings.mode == FUSED:
                fused = self.fused[sampling.device]
                bodies[place] = FusedSample.KIND, fused.encode(sampling.instants, at, sampling.stream)
            else:
                raw.append(place)

        encoded = self._encode_raw([samplings[place] for place in raw], [sensed[place] for place in raw])
        for place, of_one in zip(raw, encoded, strict=True):
            bodies[place] = self._encoder.kind, of_one
        return [
            [
                sampling.frame(kind, at, body)
                for at, body in zip(sampling.instants.tolist(), of_one, strict=True)
            ]
            + self._seen(sampling, at_instants)
            for sampling, (kind, of_one), at_instants in zip(samplings, bodies, sensed, strict=True)
        ]

    def _seen(self, sampling: Sampling, sensed: Sensed) -> list[Timed]:
        """Return what the cells say, if there are any; a triggered sample has none."""
        if not self._light or sampling.trigger is not None:
            return []
        return self._light[sampling.device].frames(sampling, sensed.R_ws)

    def _wanted(self, sampling: Sampling) -> Wanted:
        return Wanted(self._column[sampling.device], sampling.times)

    def _encode_raw(self, samplings: Sequence[Sampling], sensed: Sequence[Sensed]) -> list[list[bytes]]:
        """Return bodies by sampling; encoded in one go, which costs far less than one by one."""
        if not samplings:
            return []
        readings = [self._read(sampling, at) for sampling, at in zip(samplings, sensed, strict=True)]
        sizes = [len(sampling.instants) for sampling in samplings]
        bodies = self._encoder.encode(
            {name: np.concatenate([of_one[name] for of_one in readings]) for name in SENSORS},
            {
                name: np.repeat([sampling.settings.ranges[name] for sampling in samplings], sizes)[:, None]
                for name in SENSORS
            },
            np.repeat([sampling.trigger is not None for sampling in samplings], sizes),
        )
        ends = np.cumsum(sizes).tolist()
        return [bodies[end - size : end] for end, size in zip(ends, sizes, strict=True)]

    def _read(self, sampling: Sampling, sensed: Sensed) -> dict[str, FloatArray]:
        force, rate = sensed.specific_force, sensed.angular_rate
        added = felt(self._disturbances[sampling.device], sampling.times)
        if added is not None:
            force, rate = force + added[0], rate + added[1]
        settings = sampling.settings
        read = self._sensors[sampling.device].read(force, rate, sensed.magnetic_field, settings.rate_hz)
        return calibrated(read, settings.calibration)
