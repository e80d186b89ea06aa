"""What a pose network is to the rest, and where one comes from by its name."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video.networks.weights import weights_of
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


def load_network(name: str, threads: int = 1) -> PoseNetwork:
    """Return the network ``name`` of ``NETWORKS``; threads: of one run. Raises ``GatewayError`` when it is
    unknown, its weights are missing or damaged, or the extra ``video`` is not installed."""
    weights = weights_of(name)
    path = weights.verified_path()
    if name == "openpose":
        from gateway.reconstruction.video.networks.openpose import OpenPose  # noqa: PLC0415 - a heavy import

        return OpenPose(path, threads)
    from gateway.reconstruction.video.networks.blazepose import BlazePose  # noqa: PLC0415 - a heavy import

    return BlazePose(path, threads)
