"""What every reconstructor is: observations in time order to skeleton frames."""

from __future__ import annotations

from typing import Protocol

from gateway.frames import ImuFrame, SkeletonFrame


class Reconstructor(Protocol):
    """Sans-I/O, no clock of its own, deterministic: the same frames give the same result, bit for bit."""

    def update(self, observation: ImuFrame) -> SkeletonFrame: ...

    def reset(self) -> None:
        """Forget everything but the parameters."""
        ...
