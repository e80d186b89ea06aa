"""A module that fuses on board: orientation and displacement as it would have estimated them."""

from __future__ import annotations

import numpy as np

from devices.deferred import Rotation
from devices.emulators.bodies import FloatArray
from devices.emulators.imperfections import Imperfections, module_random
from devices.emulators.sensed_motion import Sensed
from firmware_protocol import FusedSample
from firmware_protocol.fields import BYTE_ORDER, INTEGER_RANGE, layout_of

_PURPOSE = 13

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
        self._rng = module_random(seed, module, _PURPOSE)
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
