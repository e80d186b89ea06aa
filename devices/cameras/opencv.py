"""OpenCV, imported when first used: commands that need it are still listed where it is not installed."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__all__ = ["cv2"]


class _OpenCV:
    """Its attributes are those of the module; raises ``ModuleNotFoundError`` where there is none."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module("cv2"), name)


if TYPE_CHECKING:
    import cv2
else:
    cv2 = _OpenCV()
