"""Frames of an optical system to poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from gateway.contract.balances import Balance
from gateway.frames import MarkerFrame, SkeletonFrame
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor, warm_up
from gateway.stages.stage import StageContext


class MarkerStage:
    """An optical system's frames are whole as they come."""

    def __init__(self, context: StageContext) -> None:
        assert context.suit.markers is not None  # or their source would have been refused
        warm_up()
        self.reconstructor = OpticalReconstructor(context.suit.skeleton, context.suit.markers)

    def add(self, observations: Sequence[MarkerFrame], arrived_ns: int) -> list[MarkerFrame]:
        """Return the frames themselves."""
        return list(observations)

    def solve(self, frames: Sequence[MarkerFrame]) -> list[SkeletonFrame]:
        """Return the poses of frames in time order."""
        return [self.reconstructor.update(frame) for frame in frames]

    def statistics(self) -> Mapping[str, object]:
        """Return how well the last pose explains its markers, and what was put right."""
        last = self.reconstructor.last
        return {
            "markers": {
                "counts": dict(self.reconstructor.counts),
                "rmse_mm": None if last is None else round(1e3 * last.rmse, 3),
            }
        }

    def balances(self) -> Iterable[Balance]:
        """Yield nothing: every frame has a pose."""
        return ()
