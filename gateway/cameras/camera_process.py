"""A camera in a process of its own: it decodes, finds the person, runs the network, and hands over
heat-map messages in the order of the pictures.

What goes over the pipe: from the child ``("opened", PictureInfo)``, ``("people", [Person, …])`` of the first
picture, then messages as bytes, at last ``("end", None)``, or ``("error", text)``; to the child, once,
the region to follow or None.
"""

from __future__ import annotations

import multiprocessing
import signal
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from devices.cameras.heat_map_messages import HeatMapMessage, encode_heat_maps, quantised
from devices.cameras.pictures import CameraError, PictureInfo, open_pictures
from devices.device_errors import DeviceError
from gateway.cameras.person_follower import PersonFollower
from gateway.errors import GatewayError
from gateway.reconstruction.video.networks.network import Picture, load_network
from gateway.reconstruction.video.networks.person_detector import Person, PersonDetector
from gateway.reconstruction.video.region import PersonRegion

_NOWHERE = np.zeros((2, 3))
_PATIENCE_S = 120.0
"""For one picture: a heavy network on a busy machine takes seconds at the worst."""


@dataclass(frozen=True)
class CameraTask:
    """What a camera's process is to do."""

    name: str
    """Of the camera, as the calibration has it."""
    place: str
    """See ``devices.cameras.pictures``."""
    network: str
    rate_hz: float | None = None
    """Of a folder of images."""
    skip: int = 0
    """Pictures at the start that are left out: the camera began so much earlier than the others."""


class CameraProcess:
    """The parent's end of one camera."""

    def __init__(self, task: CameraTask) -> None:
        """Starts the process. Nothing is waited for before the first question."""
        self.task = task
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        name = f"camera {task.name}"
        self._process = context.Process(target=_run, args=(task, theirs), name=name, daemon=True)
        self._process.start()
        theirs.close()
        self._has_ended = False

    def info(self) -> PictureInfo:
        """What the opened source says of itself; the first question. Raises ``CameraError``."""
        info: PictureInfo = self._answer("opened")
        return info

    def people(self) -> list[Person]:
        """Everybody in the first picture; the second question. Raises ``CameraError``."""
        people: list[Person] = self._answer("people")
        return people

    def follow(self, region: PersonRegion | None) -> None:
        """Whom to take; None: whoever is found first. After this the messages come."""
        self._pipe.send(region)

    def message(self) -> bytes | None:
        """The heat maps of the next picture; None at the end. Raises ``CameraError`` when the camera failed
        or its process has died."""
        return None if self._has_ended else self._answer("message")

    def close(self) -> None:
        """End the process, wherever it is."""
        self._pipe.close()
        self._process.terminate()
        self._process.join()

    def _answer(self, wanted: str) -> Any:
        try:
            if not self._pipe.poll(_PATIENCE_S):
                raise CameraError(f"camera '{self.task.name}': gave no picture for {_PATIENCE_S:.0f} s")
            answer = self._pipe.recv()
        except (EOFError, ConnectionError):
            self._process.join(5.0)
            raise CameraError(
                f"camera '{self.task.name}': its process ended by itself (exit code "
                f"{self._process.exitcode}); where memory ran out, try fewer cameras or the network 'lite'"
            ) from None
        if isinstance(answer, bytes):
            return answer
        kind, content = answer
        if kind == "error":
            raise CameraError(f"camera '{self.task.name}': {content}")
        if kind == "end":
            self._has_ended = True
            return None
        assert kind == wanted
        return content


def _run(task: CameraTask, pipe: Connection) -> None:
    """The child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    try:
        _serve(task, pipe)
    except (DeviceError, GatewayError) as error:
        pipe.send(("error", str(error)))
    except (BrokenPipeError, EOFError):
        return  # the parent has gone


def _serve(task: CameraTask, pipe: Connection) -> None:
    source = open_pictures(task.place, task.rate_hz)
    pipe.send(("opened", source.info))
    follower = PersonFollower(load_network(task.network), PersonDetector())
    has_begun = False
    for index, (time_ns, picture) in enumerate(source):
        if index < task.skip:
            continue
        if not has_begun:
            _begin(follower, picture, pipe)
            has_begun = True
        pipe.send(message_of(follower, picture, task, *instant_of(task, source.info, index, time_ns)))
    if not has_begun:
        pipe.send(("error", f"{task.place} has no picture after the first {task.skip}"))
    pipe.send(("end", None))


def instant_of(task: CameraTask, info: PictureInfo, index: int, time_ns: int) -> tuple[int, int]:
    """Sequence and time of a picture.

    Live, the sequence counts intervals since the epoch: cameras of one clock then agree on it.
    """
    if info.count is None:
        return round(time_ns * info.rate_hz * 1e-9) % (1 << 32), time_ns
    return index - task.skip, time_ns - round(task.skip * 1e9 / info.rate_hz)


def _begin(follower: PersonFollower, picture: Picture, pipe: Connection) -> None:
    pipe.send(("people", follower.people(picture)))
    chosen = pipe.recv()
    if chosen is not None:
        follower.follow(chosen)


def message_of(
    follower: PersonFollower, picture: Picture, task: CameraTask, sequence: int, time_ns: int
) -> bytes:
    """The heat maps of one picture as they go over the wire."""
    maps = follower.heat_maps(picture)
    return encode_heat_maps(
        HeatMapMessage(
            task.name, task.network, sequence, time_ns,
            None if maps is None else quantised(maps.likelihood),
            _NOWHERE if maps is None else maps.map_from_pixel,
        )
    )  # fmt: skip
