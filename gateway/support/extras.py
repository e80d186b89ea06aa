"""Whether the packages that only some commands need are installed."""

from __future__ import annotations

import importlib.util

from devices.extras import how_to_add
from gateway.errors import GatewayError

_NEEDED_BY = {
    "pygltflib": ("glTF", "export"),
    "pyarrow": ("Parquet", "export"),
    "foxglove": ("Foxglove", "foxglove"),
    "viser": ("the page", "viewer"),
    "matplotlib": ("a report", "plot"),
}
"""By name of a package: what needs it, and the extra that brings it."""
_VIDEO = {"cv2": "OpenCV", "ai_edge_litert": "ai-edge-litert"}


def require_package(package: str) -> None:
    """Raise ``GatewayError`` where a package is missing, saying what needs it and how to add it."""
    if importlib.util.find_spec(package) is None:
        what, extra = _NEEDED_BY[package]
        raise GatewayError(f"{what} needs the extra '{extra}': {how_to_add(extra)}")


def require_video_extra() -> None:
    """Raise ``GatewayError`` where a package that cameras need is missing, saying how to add it."""
    for module, name in _VIDEO.items():
        if importlib.util.find_spec(module) is None:
            raise GatewayError(f"{name} is not installed: {how_to_add('video')} adds it")
