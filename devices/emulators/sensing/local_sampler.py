"""The measurements of one local measuring device: true motion → noise → packets."""

from __future__ import annotations

import numpy as np

from devices.deferred import Rotation
from devices.emulators.bodies import EmulatedLocalDevice, FloatArray
from devices.emulators.device.sampling import Sampling
from devices.emulators.device.sender import Timed
from devices.emulators.imperfections import module_random
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.sensing.ideal_sensors import AIR_VELOCITY, measure_point
from firmware_protocol import LocalMeasurement, PressureSample, encode_packet
from firmware_protocol.samples import VELOCITY

SEA_LEVEL_PA, ROOM_C = 101_325.0, 20.0
AIR_DENSITY = SEA_LEVEL_PA / (287.05 * (ROOM_C + 273.15))
"""kg/m³."""
_PURPOSE = 12


class LocalSampler:
    """What a local measuring device measures and sends when it samples."""

    def __init__(self, motion: BodyMotion, device: EmulatedLocalDevice, seed: int) -> None:
        self._motion = motion
        self._device = device
        self._rng = module_random(seed, device.module, _PURPOSE)
        self._prepared = np.empty(0), np.empty((0, 3))

    def sample(self, sampling: Sampling, planned: FloatArray) -> list[Timed]:
        """Return its wire frames, values in world axes (of pressure tubes: along them).

        planned: (n,) true times after these at which it will probably sample; evaluated with them.
        """
        true_values = self._look_up(sampling.times)
        if true_values is None:
            self._prepare(np.concatenate([sampling.times, planned]))
            true_values = self._prepared[1][: len(sampling.times)]
        values = true_values + self._device.sigma * self._rng.standard_normal(true_values.shape)
        packets = [self._packet(x, y, z) for x, y, z in values.tolist()]
        return [
            sampling.frame(packet.KIND, at, encode_packet(packet))
            for at, packet in zip(sampling.instants.tolist(), packets, strict=True)
        ]

    def _packet(self, x: float, y: float, z: float) -> LocalMeasurement | PressureSample:
        device = self._device
        if device.quantity == AIR_VELOCITY:
            return PressureSample((x, y, z), SEA_LEVEL_PA, ROOM_C)
        return LocalMeasurement(device.quantity, (x, y, z), (device.sigma,) * 3)

    def _look_up(self, times: FloatArray) -> FloatArray | None:
        prepared, values = self._prepared
        start = int(prepared.searchsorted(times[0]))
        found = prepared[start : start + len(times)]
        is_there = len(found) == len(times) and bool((found == times).all())
        return values[start : start + len(times)] if is_there else None

    def _prepare(self, times: FloatArray) -> None:
        device = self._device
        state = self._motion.module_state(np.array([device.segment]), times[:, None])
        quantity = VELOCITY if device.quantity == AIR_VELOCITY else device.quantity
        values = measure_point(state, device.position[None], quantity)[:, 0]
        if device.quantity == AIR_VELOCITY:
            R_bd = Rotation.from_quat(device.orientation, scalar_first=True).as_matrix()
            along = np.einsum("tji,tj->ti", state.R_wb[:, 0] @ R_bd, values)
            values = 0.5 * AIR_DENSITY * along * np.abs(along)
        self._prepared = times, values
