"""BlazePose's landmark network: 256 pixels a side in, 33 heat maps of 64 cells out.

Bazarevsky et al. 2020, "BlazePose: On-device real-time body pose tracking"; weights of MediaPipe.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video.networks.cropping import cropped, shrunk_map
from gateway.reconstruction.video.networks.keypoints import BLAZEPOSE
from gateway.reconstruction.video.networks.network import Picture
from gateway.reconstruction.video.networks.tensors import FloatTensor, LiteModel
from gateway.reconstruction.video.region import PersonRegion

_LOGITS = "Identity_3"
"""Heat maps before the sigmoid, 33 keypoints and six auxiliary ones."""
CELLS_STAND_FOR_EDGES = True
"""Measured: peaks in mirrored pictures mirror those in the picture only so; else all are half a cell (a
hundredth of a person's height) to the lower right."""


class BlazePose:
    """One instance a process: a LiteRT interpreter is not shared."""

    keypoints = BLAZEPOSE

    def __init__(self, path: Path, threads: int = 1) -> None:
        self._model = LiteModel(path, threads)

    def heat_maps(self, picture: Picture, region: PersonRegion) -> CameraHeatMaps:
        """Return the maps of the person in the region."""
        size = self._model.size
        map_to_crop = region.affine(size)
        crop = cropped(picture, map_to_crop, size)[:, :, ::-1].astype(np.float32) / np.float32(255)
        (logits,) = self._model.run(crop, _LOGITS)
        likelihood = _sigmoid(logits[0, :, :, : len(BLAZEPOSE)])
        map_to_cell = shrunk_map(map_to_crop, size / likelihood.shape[0], of_edge=CELLS_STAND_FOR_EDGES)
        return CameraHeatMaps(np.ascontiguousarray(likelihood.transpose(2, 0, 1)), map_to_cell)


def _sigmoid(logits: FloatTensor) -> FloatTensor:
    return np.float32(1) / (np.float32(1) + np.exp(-np.clip(logits, -60, 60)))
