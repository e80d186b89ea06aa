"""The moving picture of an analysis: 30 a second, as WebM, which browsers play."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gateway.analysis.analysing import Analysis
from gateway.analysis.drawing import HEIGHT, WIDTH, draw, require_opencv, scene_of
from gateway.analysis.muscles import MuscleResult
from gateway.errors import GatewayError

RATE_HZ = 30
_CODEC = "VP80"
"""Free of licences, and in every build of opencv that has ffmpeg."""


def write_film(
    found: Analysis,
    muscles: MuscleResult | None,
    target: Path,
    slower: float = 1.0,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Write pictures into ``target`` (.webm); return how many. slower: 4 for a quarter of the speed.

    Raises ``GatewayError`` without opencv, or when the file cannot be written.
    """
    cv2 = require_opencv()
    scene = scene_of(found)
    shown = np.arange(found.time_s[0], found.time_s[-1], 1.0 / (RATE_HZ * slower))
    frames = np.searchsorted(found.time_s, shown).clip(0, len(found.time_s) - 1)
    writer = cv2.VideoWriter(str(target), cv2.VideoWriter_fourcc(*_CODEC), float(RATE_HZ), (WIDTH, HEIGHT))
    if not writer.isOpened():
        raise GatewayError(f"{target} cannot be written as WebM: is the folder writable, has opencv ffmpeg?")
    try:
        for done, frame in enumerate(frames.tolist()):
            writer.write(draw(found, muscles, frame, scene))
            if progress is not None:
                progress(done, len(frames))
    finally:
        writer.release()
    return len(frames)
