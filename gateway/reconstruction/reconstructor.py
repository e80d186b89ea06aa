"""What every reconstructor is: observations in time order to skeleton frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from gateway.frames import ImuFrame, SkeletonFrame


class Reconstructor(Protocol):
    """Sans-I/O, no clock of its own, deterministic: the same frames give the same result, bit for bit."""

    def update(self, observation: ImuFrame) -> SkeletonFrame: ...

    def reset(self) -> None:
        """Forget everything but the parameters."""
        ...


@runtime_checkable
class BatchReconstructor(Reconstructor, Protocol):
    """One that takes many frames in one call, with the same result as one after the other."""

    def update_many(self, observations: Sequence[ImuFrame]) -> list[SkeletonFrame]: ...


def update_many(reconstructor: Reconstructor, observations: Sequence[ImuFrame]) -> list[SkeletonFrame]:
    """Frames in time order through any reconstructor, in one call where it can."""
    if isinstance(reconstructor, BatchReconstructor):
        return reconstructor.update_many(observations)
    return [reconstructor.update(observation) for observation in observations]
