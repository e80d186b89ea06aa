"""The people before cameras, live and in films: who comes, where they are, and who has gone.

Cameras find people by themselves, and follow each under a number of their own, until they are told where the
pose of all cameras will have them. Somebody whose hips and shoulders meet in the world by the rays of
several cameras is tracked; once the lengths of the body are known, the person has entered, and gets a number
that nobody had before. Whoever has just left, and could have come back by now, is known by these lengths.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from devices.cameras.heat_map_messages import HeatMapReceiver
from devices.link import Chunk
from gateway.body.camera import Camera, project
from gateway.body.skeleton import VideoSetUp, WornSuit
from gateway.cameras.people_matching import matched_people
from gateway.cameras.returning_people import ReturningPeople, Somebody
from gateway.frames import CameraHeatMaps, FloatArray, HeatMapFrame
from gateway.reconstruction.video.crowd import VideoCrowd
from gateway.reconstruction.video.keypoint_set import KeypointSet, load_keypoint_set
from gateway.reconstruction.video.leading import Leading
from gateway.reconstruction.video.networks.imported import person_of
from gateway.reconstruction.video.networks.person_detector import Person
from gateway.reconstruction.video.networks.weights import keypoint_set_of
from gateway.reconstruction.video.reconstructor import VideoReconstructor, worn_person
from gateway.reconstruction.video.region import peaks
from gateway.reconstruction.video.tracker import KeypointTracker
from gateway.sources.heat_maps import CameraInstant, CameraInstants, KnownCameras, encoded_maps, heat_maps_of

AHEAD = 2
"""Pictures from a pose to those that its orders are for: while the pose of one instant is found, the cameras
look at the next one, and what comes out does not depend on who is faster."""
_TRIAL = 40
"""Instants in which somebody must enter, or be given up."""
_LEAST_TRIAL = 0.5
"""Share of the instants of the trial in which somebody must be there."""
_LEAST_SEEN = 0.3
"""Share of the keypoints that two cameras must show where the pose has them, for somebody to be there; how
likely each must be, too. One camera alone holds whoever has left to somebody else on the same rays."""
_ABSENT = 20
"""Instants in a row in which somebody is not there, before they have left."""
_MISSED = 5
"""The same, before they have left when somebody who has just been measured stands where they were lost."""
_WITHIN_M = 0.3
"""Median distance of keypoints under which somebody is led by another one's, and is not where they seem."""
_NEAR = 0.5
"""Distance of hips, in sizes of a person, under which a camera shows somebody who is known already."""


@dataclass
class _Tracked:
    """Somebody who is tracked."""

    ordered_number: int
    """Number in the orders to the cameras."""
    found: dict[int, int]
    """By camera's row, the number under which it had found the person."""
    number: int | None = None
    """None: on trial."""
    person: KeypointSet | None = None
    """Of the lengths that were measured; None: on trial."""
    instants: int = 0
    there: int = 0
    """Instants in which the person was there."""
    absent: int = 0
    """Instants since."""
    seen: list[list[bytes]] = field(default_factory=list)
    """While on trial: of every instant, a message a camera."""
    hips: FloatArray | None = None
    """(3,) m, where the person was last there."""
    seen_ns: int = 0
    """When that was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CrowdInstant:
    """What one instant brought."""

    messages: Mapping[int, Sequence[bytes]]
    """By number, a message a camera with the heat maps without the other people: as of a single person."""
    orders: bytes
    """For the cameras."""
    entered: Mapping[int, WornSuit] = field(default_factory=dict)
    """By number, with the lengths that were measured. A number that has left before: they are back."""
    before: Mapping[int, Sequence[Sequence[bytes]]] = field(default_factory=dict)
    """Of those who entered, the messages of every instant from when they were found to this one."""
    absent: Mapping[int, int] = field(default_factory=dict)
    """By the numbers in ``messages``, instants since somebody was last there; they may be waited for."""
    left: Sequence[int] = ()
    """Numbers of those who are gone."""


@dataclass
class CrowdCounts:
    """What became of the messages and people."""

    refused: Counter[str] = field(default_factory=Counter)
    """unknown_camera, other_network, too_late."""
    entered: int = 0
    """For the first time."""
    returned: int = 0
    left: int = 0
    given_up: int = 0
    """On trial, for no person was there, or one who is tracked already."""


class LiveCrowd:
    """Heat-map messages of several people in, those of each person out. Sans-I/O and deterministic."""

    def __init__(self, video: VideoSetUp, most: int) -> None:
        """Begin with nobody. most: people that are tracked at once, those on trial too."""
        self._video, self._most = video, most
        self._cameras: Sequence[Camera] = video.cameras
        self._known = KnownCameras(video)
        keypoints = load_keypoint_set(keypoint_set_of(video.network))
        self._names = keypoints.names
        self._crowd = VideoCrowd(video.cameras, keypoints, 0)
        self._leading = Leading(video.cameras, keypoints.names, video.pairs)
        self._tracked: list[_Tracked] = []  # in the order of the crowd's people
        self._receivers: dict[str, HeatMapReceiver] = {}
        self._instants = CameraInstants(len(video.cameras))
        self._away = ReturningPeople()
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
            reason = self._known.refuse(message, chunk.link)
            if reason is None and not self._instants.add(
                self._known.rows[message.camera], message, chunk.arrived_ns
            ):
                reason = "too_late"
            if reason is not None:
                self.counts.refused[reason] += 1
            for instant in self._instants.complete():
                yield self._advanced(instant)

    def take(self, messages: Sequence[bytes]) -> CrowdInstant:
        """Return what one instant of a film brings: of every camera all that it tells of one picture."""
        received = {row: HeatMapReceiver().receive(each) for row, each in enumerate(messages)}
        first = received[0][0]
        return self._advanced(CameraInstant(first.sequence, first.time_ns, received))

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
            "returned": self.counts.returned,
            "left": self.counts.left,
            "given_up": self.counts.given_up,
        }

    def _advanced(self, instant: CameraInstant) -> CrowdInstant:
        expected = self._crowd.expected_after(1)
        masked = self._crowd.masked([self._frame_of(each, instant) for each in self._tracked])
        self._crowd.follow(masked)
        messages = {}
        for index, (each, points, frame) in enumerate(zip(self._tracked, expected, masked, strict=True)):
            others = [other for k, other in enumerate(expected) if k != index and other is not None]
            self._note(each, points, others, frame)
            encoded = self._encoded(frame, instant)
            if each.number is None:
                each.seen.append(encoded)
            else:
                messages[each.number] = encoded
        absent = {each.number: each.absent for each in self._tracked if each.number is not None}
        left = self._parted()
        entered = self._entered()
        for back in entered:  # some had not been given up before
            messages.pop(back, None)
            absent.pop(back, None)
        self._admit(instant)
        return CrowdInstant(
            messages=messages,
            orders=self._orders(instant.sequence),
            entered={number: worn_person(person, self._video) for number, (person, _) in entered.items()},
            before={number: seen for number, (_, seen) in entered.items()},
            absent=absent,
            left=left,
        )

    def _note(
        self, each: _Tracked, points: FloatArray | None, others: Sequence[FloatArray], frame: HeatMapFrame
    ) -> None:
        """Keep whether somebody is where their keypoints are expected, (n_keypoints, 3) m as the others'."""
        is_there = points is not None and self._is_there(points, frame)
        each.instants += 1
        each.there += is_there
        each.absent = 0 if is_there else each.absent + 1
        if is_there and points is not None and not any(_are_one(points, other) for other in others):
            each.hips, each.seen_ns = self._hips(points), frame.time_ns

    def _is_there(self, points: FloatArray, frame: HeatMapFrame) -> bool:
        """Return whether two cameras at least show enough of the keypoints where they are expected,
        (n_keypoints, 3) m."""
        seen = np.zeros(len(self._names), dtype=np.int64)
        for camera, maps in zip(self._cameras, frame.cameras, strict=True):
            if maps is not None:
                seen += _likelihood_at(maps, project(camera, points)) >= _LEAST_SEEN
        return float((seen >= 2).mean()) >= _LEAST_SEEN

    def _frame_of(self, tracked: _Tracked, instant: CameraInstant) -> HeatMapFrame:
        """Return the heat maps of every camera of a person, by the gateway's number, else by that under
        which it was found."""
        maps: list[CameraHeatMaps | None] = []
        for row in range(len(self._cameras)):
            messages = {message.person: message for message in instant.messages.get(row, ())}
            maps.append(
                heat_maps_of(messages.get(tracked.ordered_number) or messages.get(tracked.found.get(row, -1)))
            )
        return HeatMapFrame(instant.sequence, instant.time_ns, tuple(maps))

    def _encoded(self, frame: HeatMapFrame, instant: CameraInstant) -> list[bytes]:
        """Return the messages of all cameras, those too that sent nothing, so that nobody waits for them."""
        time_ns = instant.messages[min(instant.messages)][0].time_ns
        return [
            encoded_maps(camera.name, self._video.network, frame.sequence, time_ns, maps)
            for camera, maps in zip(self._cameras, frame.cameras, strict=True)
        ]

    def _parted(self) -> list[int]:
        """Forget whoever is gone, is somebody else, or was nobody; return the numbers of those who had
        entered."""
        entering = list(filter(None, map(self._measured, self._tracked, self._crowd.trackers)))
        gone = [
            index
            for index, (each, tracker) in enumerate(zip(self._tracked, self._crowd.trackers, strict=True))
            if index in self._crowd.same_as
            or (each.absent >= _MISSED and _is_replaced(each, entering))
            or (each.number is not None and each.absent >= _ABSENT)
            or (each.number is not None and tracker.pose is None)
            or (each.number is None and each.instants - each.there > (1.0 - _LEAST_TRIAL) * _TRIAL)
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
                if somebody := _last_seen(each):
                    self._away.add(each.number, somebody)
        return left

    def _measured(self, each: _Tracked, tracker: KeypointTracker) -> Somebody | None:
        """Return somebody whose trial has ended well; None: somebody else."""
        is_person = each.there >= _LEAST_TRIAL * each.instants
        if each.number is not None or each.hips is None or not (tracker.is_settled and is_person):
            return None
        return Somebody(tracker.person, each.hips, each.seen_ns)

    def _entered(self) -> dict[int, tuple[KeypointSet, list[list[bytes]]]]:
        """Number those whose trial has ended well; return each as measured, and what was seen on trial."""
        entered = {}
        for each, tracker in zip(self._tracked, self._crowd.trackers, strict=True):
            if somebody := self._measured(each, tracker):
                each.number, each.person = self._numbered(somebody)
                entered[each.number] = each.person, each.seen
                each.seen = []
        return entered

    def _numbered(self, somebody: Somebody) -> tuple[int, KeypointSet]:
        """Return the number and the lengths of somebody new, or who is back."""
        if back := self._away.known_again(somebody):
            self.counts.returned += 1
            return back
        self.counts.entered += 1
        return self.counts.entered, somebody.person

    def _admit(self, instant: CameraInstant) -> None:
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
            newcomer = _Tracked(self._tracked_ever, own)
            newcomer.seen.append(self._encoded(self._frame_of(newcomer, instant), instant))
            self._tracked.append(newcomer)
            self._crowd.enter()

    def _found(self, row: int, instant: CameraInstant) -> list[tuple[Person, int]]:
        """Return whom a camera has found by itself and nobody is known to be, with its number for them."""
        known = {each.found.get(row) for each in self._tracked}
        numbers = {each.ordered_number for each in self._tracked}
        found = []
        for message in instant.messages.get(row, ()):
            maps = heat_maps_of(message)
            if maps is None or message.person in known or message.person in numbers:
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
        expected = zip(self._tracked, self._crowd.expected_after(AHEAD), strict=True)
        people = {each.ordered_number: points for each, points in expected if points is not None}
        return self._leading.orders(sequence + AHEAD, people)


def _last_seen(each: _Tracked) -> Somebody | None:
    """Return somebody with a number where they were last there."""
    if each.person is None or each.hips is None:
        return None
    return Somebody(each.person, each.hips, each.seen_ns)


def _is_replaced(each: _Tracked, entering: Sequence[Somebody]) -> bool:
    """Return whether one of those who have just been measured stands where somebody was lost."""
    lost = _last_seen(each)
    return lost is not None and any(newcomer.is_where_lost(lost) for newcomer in entering)


def _are_one(points: FloatArray, other: FloatArray) -> bool:
    """Return whether keypoints (n_keypoints, 3) m are within another one's body."""
    return float(np.median(np.linalg.norm(points - other, axis=1))) < _WITHIN_M


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
