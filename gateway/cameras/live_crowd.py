"""The people before served cameras: who comes, where they are, and who has gone.

Cameras find people by themselves, and follow each under a number of their own, until they are told where the
pose of all cameras will have them. Somebody whose hips and shoulders meet in the world by the rays of
several cameras is tracked; once the lengths of the body are known, the person has entered, and gets a number
that nobody had before.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from devices.cameras.heat_map_messages import (
    HeatMapMessage,
    HeatMapReceiver,
    encode_heat_maps,
    quantised,
)
from devices.cameras.orders import Square, encode_orders
from devices.link import Chunk
from gateway.body.camera import Camera, project
from gateway.body.skeleton import VideoSetUp, WornSuit
from gateway.cameras.people_matching import matched_people
from gateway.cameras.steering import AHEAD
from gateway.frames import CameraHeatMaps, FloatArray, HeatMapFrame
from gateway.reconstruction.video.crowd import VideoCrowd
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.imported import person_of
from gateway.reconstruction.video.networks.person_detector import Person
from gateway.reconstruction.video.networks.weights import keypoint_set_of
from gateway.reconstruction.video.reconstructor import VideoReconstructor, worn_person
from gateway.reconstruction.video.region import peaks
from gateway.reconstruction.video.regions import person_region, square_of
from gateway.sources.heat_maps import Instant, Instants, heat_maps_of

_TRIAL = 40
"""Instants after which somebody who has not entered is given up."""
_LEAST_TRIAL = 0.5
"""Share of the instants of the trial in which somebody must be there."""
_LEAST_SEEN = 0.3
"""Share of the keypoints that two cameras must show where the pose has them, for somebody to be there; how
likely each must be, too. One camera alone holds whoever has left to somebody else on the same rays."""
_ABSENT = 20
"""Instants in a row in which somebody is not there, before they have left."""
_NEAR = 0.5
"""Distance of hips, in sizes of a person, under which a camera shows somebody who is known already."""
_NOWHERE = np.zeros((2, 3))


@dataclass
class _Tracked:
    """Somebody who is tracked."""

    told: int
    """Number that the cameras are told."""
    found: dict[int, int]
    """By camera's row, the number under which it had found the person."""
    number: int | None = None
    """None: on trial."""
    instants: int = 0
    there: int = 0
    """Instants in which the person was there."""
    absent: int = 0
    """Instants since."""


@dataclass(frozen=True, slots=True)
class CrowdInstant:
    """What one instant brought."""

    entered: Mapping[int, WornSuit]
    """By number, with the lengths that were measured."""
    chunks: Mapping[int, bytes]
    """By number, the heat maps of all cameras without the other people: messages as of a single person."""
    left: Sequence[int]
    orders: bytes
    """For the cameras."""


@dataclass
class CrowdCounts:
    """What became of the messages and people."""

    refused: Counter[str] = field(default_factory=Counter)
    """unknown_camera, other_network, too_late."""
    entered: int = 0
    left: int = 0
    given_up: int = 0
    """On trial, for no person was there, or one who is tracked already."""


class LiveCrowd:
    """Heat-map messages of several people in, those of each person out. Sans-I/O and deterministic."""

    def __init__(self, video: VideoSetUp, most: int) -> None:
        """Begin with nobody. most: people that are tracked at once, those on trial too."""
        self._video, self._most = video, most
        self._cameras: Sequence[Camera] = video.cameras
        self._row = {camera.name: row for row, camera in enumerate(video.cameras)}
        keypoints = load_keypoint_set(keypoint_set_of(video.network))
        self._names = keypoints.names
        self._crowd = VideoCrowd(video.cameras, keypoints, 0)
        self._tracked: list[_Tracked] = []  # in the order of the crowd's people
        self._receivers: dict[str, HeatMapReceiver] = {}
        self._instants = Instants(len(video.cameras))
        self._tracked_ever = 0
        self.counts = CrowdCounts()

    @property
    def present(self) -> list[int]:
        """Numbers of the people who are there."""
        return [each.number for each in self._tracked if each.number is not None]

    def solved_by(self, number: int, solver: VideoReconstructor) -> None:
        """Take somebody to be where ``solver`` has them, which gets the ``chunks`` of that number: nobody is
        tracked twice."""
        (index,) = [k for k, each in enumerate(self._tracked) if each.number == number]
        self._crowd.solved_by(index, solver)

    def receive(self, chunk: Chunk) -> Iterator[CrowdInstant]:
        """Yield the instants that a chunk completes."""
        receiver = self._receivers.setdefault(chunk.link, HeatMapReceiver())
        for message in receiver.receive(chunk.data):
            row = self._row.get(message.camera)
            if row is None:
                self.counts.refused["unknown_camera"] += 1
            elif message.network != self._video.network:
                self.counts.refused["other_network"] += 1
            elif not self._instants.add(row, message, chunk.arrived_ns):
                self.counts.refused["too_late"] += 1
            for instant in self._instants.complete():
                yield self._advanced(instant)

    def statistics(self) -> dict[str, object]:
        """Return counters for the health message."""
        unreadable: Counter[str] = Counter()
        for receiver in self._receivers.values():
            unreadable.update(receiver.dropped)
        return {
            "received": sum(receiver.received for receiver in self._receivers.values()),
            "dropped": dict(unreadable + self.counts.refused),
            "incomplete": self._instants.incomplete,
            "begun_anew": self._instants.begun_anew,
            "present": self.present,
            "entered": self.counts.entered,
            "left": self.counts.left,
            "given_up": self.counts.given_up,
        }

    def _advanced(self, instant: Instant) -> CrowdInstant:
        expected = self._crowd.expected_after(1)
        masked = self._crowd.masked([self._frame_of(each, instant) for each in self._tracked])
        self._crowd.follow(masked)
        for each, points, frame in zip(self._tracked, expected, masked, strict=True):
            is_there = points is not None and self._is_there(points, frame)
            each.instants += 1
            each.there += is_there
            each.absent = 0 if is_there else each.absent + 1
        chunks = {
            each.number: self._encoded(frame, instant)
            for each, frame in zip(self._tracked, masked, strict=True)
            if each.number is not None
        }
        left = self._parted()
        entered = self._entered()
        self._admit(instant)
        return CrowdInstant(entered, chunks, left, self._orders(instant.sequence))

    def _is_there(self, points: FloatArray, frame: HeatMapFrame) -> bool:
        """Return whether two cameras at least show enough of the keypoints where they are expected,
        (n_keypoints, 3) m."""
        seen = np.zeros(len(self._names), dtype=np.int64)
        for camera, maps in zip(self._cameras, frame.cameras, strict=True):
            if maps is not None:
                seen += _likelihood_at(maps, project(camera, points)) >= _LEAST_SEEN
        return float((seen >= 2).mean()) >= _LEAST_SEEN

    def _frame_of(self, tracked: _Tracked, instant: Instant) -> HeatMapFrame:
        """Return what every camera tells of a person, by the gateway's number, else by that under which it
        was found."""
        maps: list[CameraHeatMaps | None] = []
        for row in range(len(self._cameras)):
            told = {message.person: message for message in instant.told.get(row, ())}
            maps.append(heat_maps_of(told.get(tracked.told) or told.get(tracked.found.get(row, -1))))
        return HeatMapFrame(instant.sequence, instant.time_ns, tuple(maps))

    def _encoded(self, frame: HeatMapFrame, instant: Instant) -> bytes:
        """Return the messages of all cameras, those too that told nothing, so that nobody waits for them."""
        time_ns = instant.told[min(instant.told)][0].time_ns
        messages = (
            HeatMapMessage(
                camera.name, self._video.network, frame.sequence, time_ns,
                None if maps is None else quantised(maps.likelihood),
                _NOWHERE if maps is None else maps.map_from_pixel,
            )
            for camera, maps in zip(self._cameras, frame.cameras, strict=True)
        )  # fmt: skip
        return b"".join(map(encode_heat_maps, messages))

    def _parted(self) -> list[int]:
        """Forget whoever is gone, is somebody else, or was nobody; return the numbers of those who had
        entered."""
        gone = [
            index
            for index, (each, tracker) in enumerate(zip(self._tracked, self._crowd.trackers, strict=True))
            if index in self._crowd.same_as
            or (each.number is not None and each.absent >= _ABSENT)
            or (each.number is not None and tracker.pose is None)
            or (each.number is None and each.instants >= _TRIAL)
        ]
        left = []
        for index in reversed(gone):
            each = self._tracked.pop(index)
            self._crowd.leave(index)
            if each.number is None:
                self.counts.given_up += 1
            else:
                self.counts.left += 1
                left.append(each.number)
        return left

    def _entered(self) -> dict[int, WornSuit]:
        """Number those whose trial has ended well."""
        entered = {}
        for each, tracker in zip(self._tracked, self._crowd.trackers, strict=True):
            is_person = each.there >= _LEAST_TRIAL * each.instants
            if each.number is None and tracker.is_settled and is_person:
                self.counts.entered += 1
                each.number = self.counts.entered
                entered[each.number] = worn_person(tracker.person, self._video)
        return entered

    def _admit(self, instant: Instant) -> None:
        """Begin to track those whom several cameras have found, and nobody is known to be."""
        if len(self._tracked) >= self._most:
            return
        found = [self._found(row, instant) for row in range(len(self._cameras))]
        for chosen in matched_people(self._cameras, [[person for person, _ in each] for each in found]):
            if len(self._tracked) >= self._most:
                return
            own = {
                row: number
                for row, one in enumerate(chosen)
                for person, number in found[row]
                if person is one
            }
            self._tracked_ever += 1
            self._tracked.append(_Tracked(self._tracked_ever, own))
            self._crowd.enter()

    def _found(self, row: int, instant: Instant) -> list[tuple[Person, int]]:
        """Whom a camera has found by itself and nobody is known to be, with its number for them."""
        known = {each.found.get(row) for each in self._tracked}
        told = {each.told for each in self._tracked}
        found = []
        for message in instant.told.get(row, ()):
            maps = heat_maps_of(message)
            if maps is None or message.person in known or message.person in told:
                continue
            points, likelihood = peaks(maps)
            person = person_of(np.column_stack([points, likelihood]), self._names)
            if person is not None and not self._is_known(self._cameras[row], person):
                found.append((person, message.person))
        return found

    def _is_known(self, camera: Camera, person: Person) -> bool:
        """Return whether somebody who is tracked is where a camera shows a person."""
        for expected in self._crowd.expected_after(1):
            if expected is not None:
                apart = np.linalg.norm(project(camera, self._hips(expected)) - person.hips)
                if apart < _NEAR * person.radius:
                    return True
        return False

    def _hips(self, points: FloatArray) -> FloatArray:
        rows = [k for k, name in enumerate(self._names) if name.endswith("_hip")]
        middle: FloatArray = points[rows].mean(axis=0)
        return middle

    def _orders(self, sequence: int) -> bytes:
        """Return where everybody whose pose is known will be ``AHEAD`` pictures later."""
        by_camera: dict[str, dict[int, Square | None]] = {camera.name: {} for camera in self._cameras}
        for each, points in zip(self._tracked, self._crowd.expected_after(AHEAD), strict=True):
            if points is None:
                continue
            for camera in self._cameras:
                region = person_region(camera, points, self._names)
                by_camera[camera.name][each.told] = square_of(region)
        return encode_orders(sequence + AHEAD, by_camera)


def _likelihood_at(maps: CameraHeatMaps, pixels: FloatArray) -> FloatArray:
    """Return (n_keypoints,) of the cells that pixels (n_keypoints, 2) of the picture are in; 0 outside the
    maps."""
    n, rows, columns = maps.likelihood.shape
    affine = maps.map_from_pixel
    cells = np.rint(np.nan_to_num(pixels @ affine[:, :2].T + affine[:, 2], nan=-1.0))
    is_inside = np.asarray(((cells >= 0) & (cells < (columns, rows))).all(axis=1))
    column, row = np.where(is_inside[:, None], cells, 0).astype(np.int64).T
    found: FloatArray = np.where(is_inside, maps.likelihood[np.arange(n), row, column], 0.0)
    return found
