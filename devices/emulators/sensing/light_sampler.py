"""The photoelectric cells of the emulated modules: sun, sky, ground, clouds and shadows → packets.

A cell of normal n at full sun reads ``max(0, n · s)``; the sky adds by how much of it the cell sees,
``(1 + n_up) / 2``, the ground likewise from below.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from devices.emulators.bodies import FloatArray
from devices.emulators.device.sampling import Sampling
from devices.emulators.device.sender import Timed
from devices.emulators.imperfections import module_random
from firmware_protocol import LightSample, encode_packet

FACES: FloatArray = np.vstack([[axis, -axis] for axis in np.eye(3)])
"""(6, 3) normals in the order of the wire, sensor axes."""

_PURPOSE = 13


@dataclass(frozen=True)
class Shade:
    """Something between the sun and the cells, for a while."""

    start_s: float
    end_s: float
    direct: float = 0.0
    """Share of the direct light that is left."""
    sky: float = 1.0
    """Factor on the light of the sky: a cloud makes it brighter, a roof darker."""
    module: int | None = None
    """Number of the module it falls on; None: all."""
    cells: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    """Which of its cells: a shadow's edge falls on some."""


@dataclass(frozen=True)
class Sunlight:
    """The light around the suit; the cells are the same on all modules."""

    direction: FloatArray
    """(3,) unit vector to the sun, ENU."""
    direct: float = 0.6
    """What a cell reads that faces the sun, share of full scale."""
    sky: float = 0.10
    ground: float = 0.12
    """Of a clear day: the sky's and the ground's light on a cell that sees nothing else."""
    shades: tuple[Shade, ...] = field(default=())
    gain_error: float = 0.01
    """Standard deviation of the cells' gains."""
    noise: float = 0.002
    """Standard deviation of a reading, share of full scale."""
    normals: FloatArray = field(default_factory=FACES.copy)
    """(6, 3) sensor axes."""


class LightSampler:
    """What the cells of one module send, each time that its inertial sensors sample."""

    def __init__(self, light: Sunlight, seed: int, module: int) -> None:
        self._light = light
        self._module = module
        self._rng = module_random(seed, module, _PURPOSE)
        self._gains = 1.0 + light.gain_error * self._rng.standard_normal(6)

    def frames(self, sampling: Sampling, R_ws: FloatArray) -> list[Timed]:
        """Return the frames of a sampling; R_ws: (n, 3, 3) sensor to world at its instants."""
        readings = self.read(sampling.times, R_ws)
        bodies = [encode_packet(LightSample(tuple(row))) for row in readings.tolist()]
        return [
            sampling.frame(LightSample.KIND, at, body)
            for at, body in zip(sampling.instants.tolist(), bodies, strict=True)
        ]

    def read(self, times: FloatArray, R_ws: FloatArray) -> FloatArray:
        """Return readings (n, 6) as a share of full scale, at true times (n,)."""
        light = self._light
        normals = np.einsum("nij,kj->nki", R_ws, light.normals)  # (n, 6, 3) world
        direct, sky = np.ones(normals.shape[:2]), np.ones(normals.shape[:2])
        for shade in light.shades:
            if shade.module in {None, self._module}:
                now = (times >= shade.start_s) & (times < shade.end_s)
                shaded = np.ix_(now, np.array(shade.cells))
                direct[shaded] *= shade.direct
                sky[shaded] *= shade.sky
        above = 0.5 * (1.0 + normals[..., 2])
        readings = light.direct * direct * np.maximum(normals @ light.direction, 0.0)
        readings += light.sky * sky * above + light.ground * (1.0 - above)
        readings *= self._gains
        readings += light.noise * self._rng.standard_normal(readings.shape)
        clipped: FloatArray = np.clip(readings, 0.0, 1.0)
        return clipped
