"""Heat-map messages of several cameras to frames: put together by instant, given in order."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from devices.cameras.heat_map_messages import (
    HeatMapMessage,
    HeatMapReceiver,
    encode_heat_maps,
    quantised,
)
from devices.link import Chunk
from gateway.body.skeleton import VideoSetUp, WornSuit
from gateway.contract.balances import Balance
from gateway.frames import CameraHeatMaps, HeatMapFrame
from gateway.sources.source import ListeningSource

log = logging.getLogger(__name__)

PATIENCE = 3
PATIENCE_NS = 250_000_000
"""An instant waits for a camera that lags behind: so many instants and so long, at the least."""
SILENT_NS = 1_000_000_000
"""A camera of which nothing has come for so long is not waited for."""

_NOWHERE = np.zeros((2, 3))
"""The map from pixels where there are no heat maps."""
_MOST_LOGGED = 16
"""Different reasons for which messages are left out that are logged."""
_BEGUN_ANEW = 8
"""Pictures by which a camera's numbers must fall: less is a message that comes twice or late."""


class HeatMapSource(ListeningSource):
    """Cameras, on as many links as one likes; what they show of one instant is one frame."""

    observes = HeatMapFrame

    def __init__(self, suit: WornSuit) -> None:
        """Receive the cameras that ``suit.video`` names."""
        assert suit.video is not None
        self._known = KnownCameras(suit.video)
        self._receivers: dict[str, HeatMapReceiver] = {}
        self._instants = CameraInstants(len(self._known.rows))
        self._refused: dict[str, Counter[str]] = {}
        """By link: unknown_camera, other_network, too_late."""

    def add_link(self, name: str, content: str) -> None:
        """Announce a link."""
        self._receivers[name] = HeatMapReceiver()
        self._refused[name] = Counter()

    def receive(self, chunk: Chunk) -> list[HeatMapFrame]:
        """Return the instants that a chunk completes, in order."""
        frames: list[HeatMapFrame] = []
        for message in self._receivers[chunk.link].receive(chunk.data):
            self._take(message, chunk)
            frames += map(self._frame, self._instants.complete())
        return frames

    def _frame(self, instant: CameraInstant) -> HeatMapFrame:
        """Return the person without a number, in all cameras."""
        shown = {
            row: each for row, messages in instant.messages.items() for each in messages if each.person == 0
        }
        maps = tuple(heat_maps_of(shown.get(row)) for row in range(len(self._known.rows)))
        return HeatMapFrame(instant.sequence, instant.time_ns, maps)

    def dropped(self) -> Mapping[str, Mapping[str, int]]:
        """Return what could not be read or used, by link and reason."""
        return {name: receiver.dropped + self._refused[name] for name, receiver in self._receivers.items()}

    def statistics(self) -> Mapping[str, object]:
        """Return what became of the messages."""
        dropped: Counter[str] = Counter()
        for of_link in self.dropped().values():
            dropped.update(of_link)
        return {
            "video": {
                "received": sum(receiver.received for receiver in self._receivers.values()),
                "dropped": dict(dropped),
                "incomplete": self._instants.incomplete,
                "begun_anew": self._instants.begun_anew,
            }
        }

    def balances(self) -> Iterator[Balance]:
        """Yield the instants given."""
        yield Balance("frames", self._instants.given, {})

    def _take(self, message: HeatMapMessage, chunk: Chunk) -> None:
        reason = self._known.refuse(message, chunk.link)
        if reason is None and not self._instants.add(
            self._known.rows[message.camera], message, chunk.arrived_ns
        ):
            reason = "too_late"
        if reason is not None:
            self._refused[chunk.link][reason] += 1
        elif message.person != 0:
            self._known.warn(
                chunk.link,
                f"camera '{message.camera}' tells of several people: set 'people' in the configuration, or "
                "serve it without --people",
            )


class KnownCameras:
    """The cameras and the network that a rig is for."""

    def __init__(self, video: VideoSetUp) -> None:
        self.rows = {camera.name: row for row, camera in enumerate(video.cameras)}
        """By the camera's name, its place in the order."""
        self._network = video.network
        self._logged: set[str] = set()

    def refuse(self, message: HeatMapMessage, link: str) -> str | None:
        """Return why a message cannot be used, which is logged once with a remedy; None: it can."""
        if message.camera not in self.rows:
            reason, listed = "unknown_camera", ", ".join(self.rows)
            why = f"camera '{message.camera}' is not in the rig: serve it with the --name of one ({listed})"
        elif message.network != self._network:
            reason = "other_network"
            why = (
                f"camera '{message.camera}' sends keypoints of '{message.network}', and the rig is for "
                f"'{self._network}': serve it with --network {self._network}"
            )
        else:
            return None
        self.warn(link, f"{why}; its pictures are left out")
        return reason

    def warn(self, link: str, why: str) -> None:
        """Log something once."""
        if why not in self._logged and len(self._logged) < _MOST_LOGGED:
            self._logged.add(why)
            log.warning("link '%s': %s", link, why)


@dataclass(frozen=True, slots=True)
class CameraInstant:
    """What the cameras told of one instant."""

    sequence: int
    time_ns: int
    """Gateway time."""
    messages: Mapping[int, Sequence[HeatMapMessage]]
    """By camera's row, a message for each person that it followed; none of a camera not waited for."""


class CameraInstants:
    """Messages of several cameras put together by their sequence numbers, given out in order.

    An instant waits for a camera that may still send it: not for one that has sent a later one (the
    messages of one camera keep their order), nor for one that is silent.
    """

    def __init__(self, n_cameras: int) -> None:
        self.given = 0
        self.incomplete = 0
        """Given without every camera."""
        self.begun_anew = 0
        """A camera counted from its beginning again: a file was played once more, or a clock set back."""
        self._n = n_cameras
        self._received_ns: list[int] = []
        self._now_ns = 0
        self._forget()

    def _forget(self) -> None:
        self._last = [-1] * self._n
        self._waiting: dict[int, dict[int, dict[int, HeatMapMessage]]] = {}  # by sequence, row, person
        self._since_ns: dict[int, int] = {}
        self._done = -1
        self._offset_ns: int | None = None

    def add(self, row: int, message: HeatMapMessage, arrived_ns: int) -> bool:
        """Add the message of camera ``row``; return False if its instant was already given."""
        self._now_ns = arrived_ns
        self._received_ns = self._received_ns or [arrived_ns] * self._n
        self._received_ns[row] = arrived_ns
        # A sequence number far below the last one means that the sender was restarted.
        if message.sequence <= self._last[row] - _BEGUN_ANEW:
            self.begun_anew += 1
            self._forget()
        self._last[row] = max(message.sequence, self._last[row])
        if message.sequence <= self._done:
            return False
        # the senders share a clock; its offset is that of the least delayed message
        offset = arrived_ns - message.time_ns
        self._offset_ns = offset if self._offset_ns is None else min(self._offset_ns, offset)
        self._waiting.setdefault(message.sequence, {}).setdefault(row, {})[message.person] = message
        self._since_ns.setdefault(message.sequence, arrived_ns)
        return True

    def complete(self) -> Iterator[CameraInstant]:
        """Yield instants that all cameras have told of, or that are given up waiting for, in order."""
        while self._waiting:
            first = min(self._waiting)
            if self._is_awaited(first):
                return
            messages = {row: list(people.values()) for row, people in self._waiting.pop(first).items()}
            del self._since_ns[first]
            self._done = first
            self.given += 1
            self.incomplete += len(messages) < self._n
            assert self._offset_ns is not None
            yield CameraInstant(first, messages[min(messages)][0].time_ns + self._offset_ns, messages)

    def _is_awaited(self, sequence: int) -> bool:
        """Return whether a camera may still tell of this instant, and is waited for."""
        whole = {row for row, people in self._waiting[sequence].items() if _is_whole(people.values())}
        missing = set(range(self._n)) - whole
        may_come = any(
            self._last[row] <= sequence and self._now_ns - self._received_ns[row] < SILENT_NS
            for row in missing
        )
        is_new = self._now_ns - self._since_ns[sequence] < PATIENCE_NS
        return may_come and (is_new or max(self._waiting) - sequence < PATIENCE)


def _is_whole(messages: Iterable[HeatMapMessage]) -> bool:
    """Return whether the last message of a picture is among those that came of it."""
    return any(message.following == 0 for message in messages)


def heat_map_frame(sequence: int, messages: Sequence[bytes]) -> HeatMapFrame:
    """Return a frame of one instant's messages, one per camera; its time is that of the first."""
    read = [HeatMapReceiver().receive(message)[0] for message in messages]
    return HeatMapFrame(sequence, read[0].time_ns, tuple(map(heat_maps_of, read)))


def encoded_maps(
    camera: str,
    network: str,
    sequence: int,
    time_ns: int,
    maps: CameraHeatMaps | None,
    *,
    person: int = 0,
    following: int = 0,
) -> bytes:
    """Return the message of one person in one picture of a camera, whose inverse is ``heat_maps_of``.

    maps: None: the person is not in the picture. person, following: as in ``HeatMapMessage``.
    """
    return encode_heat_maps(
        HeatMapMessage(
            camera=camera,
            network=network,
            sequence=sequence,
            time_ns=time_ns,
            likelihood=None if maps is None else quantised(maps.likelihood),
            map_from_pixel=_NOWHERE if maps is None else maps.map_from_pixel,
            person=person,
            following=following,
        )
    )


def heat_maps_of(message: HeatMapMessage | None) -> CameraHeatMaps | None:
    """Return the heat maps of a message as likelihoods of 0 to 1; None: no message, or nobody was seen."""
    if message is None or message.likelihood is None:
        return None
    return CameraHeatMaps(message.likelihood.astype(np.float32) / np.float32(255), message.map_from_pixel)
