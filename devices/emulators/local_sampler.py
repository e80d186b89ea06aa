"""The measurements of one local measuring device: true motion → noise → packets."""

from __future__ import annotations

import numpy as np

from devices.emulators.bodies import EmulatedLocalDevice, FloatArray
from devices.emulators.ideal_sensors import measure_point
from devices.emulators.imperfections import module_random
from devices.emulators.motions import BodyMotion
from devices.emulators.sampling import Sampling
from devices.emulators.sender import Timed
from firmware_protocol import LocalMeasurement, encode_packet

_PURPOSE = 12


class LocalSampler:
    """What a local measuring device measures and sends when it samples."""

    def __init__(self, motion: BodyMotion, device: EmulatedLocalDevice, seed: int) -> None:
        self._motion = motion
        self._device = device
        self._rng = module_random(seed, device.module, _PURPOSE)
        self._prepared = np.empty(0), np.empty((0, 3))

    def sample(self, sampling: Sampling, planned: FloatArray) -> list[Timed]:
        """Its wire frames, values in world axes.

        planned: (n,) true times after these at which it will probably sample; evaluated with them.
        """
        device = self._device
        true_values = self._look_up(sampling.times)
        if true_values is None:
            self._prepare(np.concatenate([sampling.times, planned]))
            true_values = self._prepared[1][: len(sampling.times)]
        values = true_values + device.sigma * self._rng.standard_normal(true_values.shape)
        sigma = (device.sigma,) * 3
        bodies = [
            encode_packet(LocalMeasurement(device.quantity, (x, y, z), sigma)) for x, y, z in values.tolist()
        ]
        return [
            sampling.frame(LocalMeasurement.KIND, at, body)
            for at, body in zip(sampling.instants.tolist(), bodies, strict=True)
        ]

    def _look_up(self, times: FloatArray) -> FloatArray | None:
        prepared, values = self._prepared
        start = int(prepared.searchsorted(times[0]))
        found = prepared[start : start + len(times)]
        is_there = len(found) == len(times) and bool((found == times).all())
        return values[start : start + len(times)] if is_there else None

    def _prepare(self, times: FloatArray) -> None:
        device = self._device
        state = self._motion.module_state(np.array([device.segment]), times[:, None])
        self._prepared = times, measure_point(state, device.position[None], device.quantity)[:, 0]
