"""What pose networks hand to the reconstructor: how likely a keypoint is at each place of a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.frames import FloatArray


@dataclass(frozen=True, slots=True)
class CameraHeatMaps:
    """The part confidence maps (PCM) of one person in one picture."""

    likelihood: NDArray[np.float32]  # (n_keypoints, rows, columns), 0 to 1
    map_from_pixel: FloatArray  # (2, 3) affine: pixel (x, y, 1) of the distorted picture to (column, row)
    """A crop that was turned and shrunk is a turned and shrunk affine."""


@dataclass(frozen=True, slots=True)
class HeatMapFrame:
    """All cameras at one instant."""

    sequence: int
    time_ns: int
    cameras: tuple[CameraHeatMaps | None, ...]
    """In the order of the calibrated cameras; None for one that has no picture of the person."""
