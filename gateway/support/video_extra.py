"""Whether what cameras need is installed: the extra ``video``."""

from __future__ import annotations

import importlib.util

from devices.extras import how_to_add
from gateway.errors import GatewayError

_PACKAGES = {"cv2": "OpenCV", "ai_edge_litert": "ai-edge-litert"}


def require_video_extra() -> None:
    """Raise ``GatewayError`` where a package is missing, saying how to add it."""
    for module, name in _PACKAGES.items():
        if importlib.util.find_spec(module) is None:
            raise GatewayError(f"{name} is not installed: {how_to_add('video')} adds it")
