"""Instants of several cameras to poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from gateway.contract.balances import Balance
from gateway.frames import HeatMapFrame, SkeletonFrame
from gateway.reconstruction.video.leading import Leading
from gateway.reconstruction.video.reconstructor import VideoPose, video_reconstructor
from gateway.stages.stage import StageContext


class CameraStage:
    """Instants are put together by their source; their poses are smoothed, so that they come a few later."""

    def __init__(self, context: StageContext) -> None:
        video = context.suit.video
        assert video is not None
        self.reconstructor = video_reconstructor(context.suit)
        self._leading = Leading(video.cameras, self.reconstructor.keypoints.names, video.pairs)
        self.last: VideoPose | None = None
        """How the last instant was explained."""
        self._settling = 0

    def add(self, observations: Sequence[HeatMapFrame], arrived_ns: int) -> list[HeatMapFrame]:
        """Return the instants themselves."""
        return list(observations)

    def solve(self, frames: Sequence[HeatMapFrame]) -> list[SkeletonFrame]:
        """Return the smoothed poses that instants in time order complete."""
        found = []
        for frame in frames:
            self.last = self.reconstructor.update(frame)
            if self.last.skeleton is None:
                self._settling += 1
            else:
                found.append(self.last.skeleton)
        return found

    def orders(self) -> bytes:
        """Return where the cameras will see the person in their next picture; nobody while none is known."""
        if self.last is None:
            return b""
        points = self.reconstructor.tracker.expected_after(1)
        return self._leading.orders(self.last.sequence + 1, {} if points is None else {0: points})

    def statistics(self) -> Mapping[str, object]:
        """Return nothing: the source tells what became of the messages."""
        return {}

    def balances(self) -> Iterator[Balance]:
        """Yield the instants before the first smoothed pose."""
        yield Balance("frames", 0, {"settling": self._settling})
