"""What a pose network is to the rest."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video.region import PersonRegion

Picture = NDArray[np.uint8]
"""(rows, columns, 3) blue, green, red."""


class PoseNetwork(Protocol):
    """A convolutional network, made ready."""

    @property
    def keypoints(self) -> tuple[str, ...]:
        """Names of its heat maps."""

    def heat_maps(self, picture: Picture, region: PersonRegion) -> CameraHeatMaps:
        """Return the maps of the one person that ``region`` shows."""
