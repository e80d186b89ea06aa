"""What every live output is."""

from __future__ import annotations

from typing import Protocol

from gateway.frames import SkeletonFrame


class Output(Protocol):
    """Takes skeleton frames. ``offer`` never waits: a slow reader must not stall sensing."""

    def offer(self, frame: SkeletonFrame) -> None: ...
