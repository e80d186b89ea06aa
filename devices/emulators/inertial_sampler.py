"""The samples of all inertial modules: true motion → imperfect readings → bodies, many at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from devices.emulators.bodies import FloatArray
from devices.emulators.disturbances import Disturbance, felt
from devices.emulators.fused_samples import FusedOutput
from devices.emulators.imperfect_sensors import ImperfectSensors, calibrated
from devices.emulators.imperfections import Imperfections, ModuleErrors
from devices.emulators.light_sampler import LightSampler, Sunlight
from devices.emulators.sample_encoding import SENSORS, SampleEncoder
from devices.emulators.sampling import FUSED, Sampling
from devices.emulators.sender import Timed
from devices.emulators.sensed_motion import Sensed, SensedMotion, Wanted
from firmware_protocol import FusedSample


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
