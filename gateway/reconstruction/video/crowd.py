"""Several people at once: each tracked by continuity in maps from which the others are taken out.

Step 9 of JP2020-042476A: people are told apart when they come, by whoever gives their first positions, and
keep their order from then on.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gateway.body.camera import Camera, project
from gateway.errors import GatewayError
from gateway.frames import CameraHeatMaps, FloatArray, HeatMapFrame
from gateway.geometry.compiled import compiled
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.lattice import Maps
from gateway.reconstruction.video.reconstructor import VideoReconstructor
from gateway.reconstruction.video.tracker import KeypointTracker, VideoOptions

_SAME_PERSON_M = 0.2
"""Median distance of two people's keypoints of one name below which they are one person: the bodies of two
would stand within each other."""
_SAME_INSTANTS = 5
"""In a row, before two are taken for one."""
_MOST_LOST = 0.7
"""Share of the keypoints that the last instant did not show, above which somebody takes nothing out of
others' maps: where they are is then a guess."""
_UP_TO_DATE = 2
"""Instants by which a solver may be behind when it is taken first: while its service starts, many wait, and
going on as it went over all of them leads cameras astray."""
_MEMORY = 30
"""Instants over which the share of keypoints that were lost is averaged."""
_SURER = 0.1
"""By which that share must be smaller to count: for a person to be kept in the place of an earlier one, or
the crowd's own tracker in the place of the solver's."""


@dataclass
class _Followed:
    """Somebody who is tracked."""

    tracker: KeypointTracker
    solver: VideoReconstructor | None = None
    """Of whoever solves this person from what ``masked`` gives, and so tracks them anyway."""
    sequence: int = -1
    """Of the last instant."""
    lost: float = 0.0
    """Share of the keypoints, averaged."""

    def follow(self, frame: HeatMapFrame) -> None:
        """Track the person in one more instant, unless the solver does."""
        self.sequence = frame.sequence
        solver = self.solver
        if solver is None or self.tracker is not solver.tracker:
            self.tracker.track(frame.cameras)
            if solver is not None and self._is_as_good(solver):
                self.tracker = solver.tracker
        self.lost += (self.tracker.lost - self.lost) / _MEMORY

    def _is_as_good(self, solver: VideoReconstructor) -> bool:
        """Return whether a solver, which has begun by itself, has come near the last instant and shows as
        much of the person."""
        tracker = solver.tracker
        is_up_to_date = self.sequence - solver.sequence <= _UP_TO_DATE
        return tracker.pose is not None and is_up_to_date and tracker.lost < self.tracker.lost + _SURER

    def expected_after(self, instants: int) -> FloatArray | None:
        """Return (n_keypoints, 3) m, so many instants after the last one; None: not known."""
        behind = 0
        if self.solver is not None and self.tracker is self.solver.tracker:
            behind = max(0, self.sequence - self.solver.sequence)
        return self.tracker.expected_after(instants + behind)


class VideoCrowd:
    """As many trackers as people. Sans-I/O and deterministic.

    Somebody who was found twice, or something else that was taken for a person and led to one, ends on the
    same body as another, as does one whom the cameras no longer see; the one whose keypoints were lost more
    often is then given up, else the later, so that they do not mask each other for long.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        keypoints: KeypointSet,
        n_people: int,
    ) -> None:
        self._cameras = tuple(cameras)
        self._make = partial(KeypointTracker, cameras, keypoints, VideoOptions())
        self._people = [_Followed(self._make()) for _ in range(n_people)]
        self.same_as: dict[int, int] = {}
        """People who turned out to be another one, with that one."""
        self._instants_together: Counter[tuple[int, int]] = Counter()

    @property
    def trackers(self) -> list[KeypointTracker]:
        """Of everybody, in their order."""
        return [each.tracker for each in self._people]

    def enter(self) -> None:
        """Add one more person, behind the others in the order."""
        self._people.append(_Followed(self._make()))

    def leave(self, index: int) -> None:
        """Forget a person; those behind move up, and who is the same as whom is looked at anew."""
        del self._people[index]
        self.same_as.clear()
        self._instants_together.clear()

    def solved_by(self, index: int, solver: VideoReconstructor) -> None:
        """Take from now on, for where a person is, what ``solver`` knows, once it has found them.

        Others feed it what ``masked`` gives of the instants to come, late or at once.
        """
        self._people[index].solver = solver

    def update(self, frames: Sequence[HeatMapFrame]) -> None:
        """Track everybody in one instant: one frame of maps for every person, in the order of the start.

        Raises ``GatewayError`` when their number is not that of the people.
        """
        self.follow(self.masked(frames))

    def follow(self, masked: Sequence[HeatMapFrame]) -> None:
        """Track everybody in one instant by frames that ``masked`` gave."""
        for person, frame in zip(self._people, masked, strict=True):
            person.follow(frame)
        self._give_up_doubles()

    def expected_after(self, instants: int) -> list[FloatArray | None]:
        """Return by person (n_keypoints, 3) m, where they will be so many instants later; None: of one whose
        pose is not known, or who is given up."""
        return [
            None if index in self.same_as else each.expected_after(instants)
            for index, each in enumerate(self._people)
        ]

    def _give_up_doubles(self) -> None:
        places = {i: places for i, places in enumerate(self.expected_after(1)) if places is not None}
        for first, second in itertools.combinations(places, 2):
            apart = float(np.median(np.linalg.norm(places[first] - places[second], axis=1)))
            pair = first, second
            self._instants_together[pair] = self._instants_together[pair] + 1 if apart < _SAME_PERSON_M else 0
            if self._instants_together[pair] >= _SAME_INSTANTS and not self.same_as.keys() & pair:
                is_second_surer = self._people[second].lost + _SURER < self._people[first].lost
                kept, given_up = (second, first) if is_second_surer else (first, second)
                self.same_as[given_up] = kept

    def masked(self, frames: Sequence[HeatMapFrame]) -> list[HeatMapFrame]:
        """Return the frames of one instant, from each what is another person's taken out, and left and right
        put right; raises as ``update``."""
        if len(frames) != len(self._people):
            raise GatewayError(f"maps of {len(frames)} people for {len(self._people)} who are tracked")
        expected = self.expected_after(1)
        masked = [self._masked(frame, index, expected) for index, frame in enumerate(frames)]
        return [
            replace(frame, cameras=tuple(person.tracker.put_right(frame.cameras)))
            for person, frame in zip(self._people, masked, strict=True)
        ]

    def _masked(self, frame: HeatMapFrame, index: int, expected: Sequence[FloatArray | None]) -> HeatMapFrame:
        """Return the maps of a person without the others; as they are until all are known; none of one who is
        given up."""
        if index in self.same_as:
            return replace(frame, cameras=(None,) * len(frame.cameras))
        own = expected[index]
        others = [
            points
            for i, points in enumerate(expected)
            if i != index and points is not None and self._people[i].tracker.lost <= _MOST_LOST
        ]
        if own is None or not others:
            return frame
        maps = tuple(
            seen if seen is None else without_others(camera, seen, own, others)
            for camera, seen in zip(self._cameras, frame.cameras, strict=True)
        )
        return replace(frame, cameras=maps)


def without_others(
    camera: Camera, maps: CameraHeatMaps, own: FloatArray, others: Sequence[FloatArray]
) -> CameraHeatMaps:
    """Return the maps with zero wherever another person's same keypoint is expected nearer by than the own
    one.

    own, others: (n_keypoints, 3) m, expected in this frame.
    """
    A = maps.map_from_pixel
    here = project(camera, own) @ A[:, :2].T + A[:, 2]
    likelihood = maps.likelihood.copy()
    for other in others:
        there = project(camera, other) @ A[:, :2].T + A[:, 2]
        _clear(likelihood, here, there)
    return CameraHeatMaps(likelihood, A)


@compiled
def _clear(likelihood: Maps, here: FloatArray, there: FloatArray) -> None:
    """Zero what is nearer to ``there`` than to ``here``, (n_keypoints, 2) columns and rows."""
    n, rows, columns = likelihood.shape
    for m in range(n):
        x, y = there[m, 0] - here[m, 0], there[m, 1] - here[m, 1]
        if not np.isfinite(x * y):
            continue
        half = 0.5 * (x * (there[m, 0] + here[m, 0]) + y * (there[m, 1] + here[m, 1]))
        for i in range(rows):
            for j in range(columns):
                if x * j + y * i > half:
                    likelihood[m, i, j] = 0.0
