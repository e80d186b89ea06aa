"""What every reconstructor is: observations in time order to skeleton frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from gateway.frames import ImuFrame, SkeletonFrame


class Reconstructor(Protocol):
    """Sans-I/O, no clock of its own, deterministic: the same frames give the same result, bit for bit."""

    def update(self, observation: ImuFrame) -> SkeletonFrame:
        """Return the pose at the instant of a frame; frames come in order of time."""
        ...

    def reset(self) -> None:
        """Forget everything but the parameters."""
        ...


def update_many(reconstructor: Reconstructor, observations: Sequence[ImuFrame]) -> list[SkeletonFrame]:
    """Return the poses of frames in time order by any reconstructor, in one call where it can."""
    many: Callable[[Sequence[ImuFrame]], list[SkeletonFrame]] | None = getattr(
        reconstructor, "update_many", None
    )
    if many is not None:
        return many(observations)
    return [reconstructor.update(observation) for observation in observations]
