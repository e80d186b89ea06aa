"""A camera in a process of its own: it decodes, finds people, runs the network, and hands over heat-map
messages in the order of the pictures. Two whose pictures are put together are in one process.

What goes over the pipe: from the child ``("opened", [PictureInfo, …])``, where one person is followed
``("people", [[Person, …], …])`` of the first pictures, by camera; then for every line of orders that it is
sent ``("messages", …)``, bytes by camera; at last ``("end", None)``, or ``("error", text)``.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from devices.cameras.pictures import CameraError, PictureInfo, PictureSource, open_pictures
from devices.commands.device_errors import DeviceError
from gateway.cameras.people_follower import FollowingCameras
from gateway.errors import GatewayError
from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video.networks.network import Picture
from gateway.reconstruction.video.networks.person_detector import Person, PersonDetector
from gateway.reconstruction.video.networks.weights import load_network
from gateway.sources.heat_maps import encoded_maps

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
    """The parent's end of one camera, or of two whose pictures are put together."""

    def __init__(self, tasks: Sequence[CameraTask], most: int = 1) -> None:
        """Start the process. Nothing is waited for before the first question. most: people that are followed
        at once."""
        self.tasks = tuple(tasks)
        self._name = " and ".join(f"'{task.name}'" for task in tasks)
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_run, args=(self.tasks, most, theirs), name=f"camera {self._name}", daemon=True
        )
        self._process.start()
        theirs.close()
        self._has_ended = False

    def infos(self) -> list[PictureInfo]:
        """Return what the opened sources say of themselves; the first question. Raises ``CameraError``."""
        infos: list[PictureInfo] = self._answer("opened")
        return infos

    def people(self) -> list[list[Person]]:
        """Return everybody in the first pictures, by camera; the second question, where one person is
        followed. Raises ``CameraError``."""
        people: list[list[Person]] = self._answer("people")
        return people

    def order(self, orders: bytes) -> None:
        """Look at the next picture, by a line of orders; empty: there are none."""
        with contextlib.suppress(ConnectionError):  # it has ended: messages() tells why
            self._pipe.send(orders)

    def messages(self) -> list[bytes] | None:
        """Return the heat maps of the next picture ordered, by camera, of everybody; None at the end. Raises
        ``CameraError`` when the camera failed or its process has died."""
        return None if self._has_ended else self._answer("messages")

    def close(self) -> None:
        """End the process, wherever it is."""
        self._pipe.close()
        self._process.terminate()
        self._process.join()

    def _answer(self, wanted: str) -> Any:
        try:
            if not self._pipe.poll(_PATIENCE_S):
                raise CameraError(f"camera {self._name}: gave no picture for {_PATIENCE_S:.0f} s")
            kind, content = self._pipe.recv()
        except (EOFError, ConnectionError):
            self._process.join(5.0)
            raise CameraError(
                f"camera {self._name}: its process ended by itself (exit code "
                f"{self._process.exitcode}); where memory ran out, try fewer cameras or the network 'lite'"
            ) from None
        if kind == "error":
            raise CameraError(content)
        if kind == "end":
            self._has_ended = True
            return None
        assert kind == wanted
        return content


def _run(tasks: Sequence[CameraTask], most: int, pipe: Connection) -> None:
    """Run the child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    with contextlib.suppress(ConnectionError, EOFError):  # the parent has gone
        try:
            _serve(tasks, most, pipe)
        except (DeviceError, GatewayError) as error:
            pipe.send(("error", str(error)))


def _serve(tasks: Sequence[CameraTask], most: int, pipe: Connection) -> None:
    sources = []
    for task in tasks:
        with _naming(task):
            sources.append(open_pictures(task.place, task.rate_hz))
    infos = [source.info for source in sources]
    pipe.send(("opened", infos))
    detector, network = PersonDetector(), load_network(tasks[0].network)
    cameras = FollowingCameras([task.name for task in tasks], network, detector, most)
    shown = [_pictures(task, source) for task, source in zip(tasks, sources, strict=True)]
    done = 0
    for done, instant in enumerate(zip(*shown, strict=False), start=1):
        pictures = [picture for _, _, picture in instant]
        if most == 1 and done == 1:
            pipe.send(("people", [detector.people(picture) for picture in pictures]))
        cameras.take(pipe.recv())
        messages = [
            messages_of(maps, task, *instant_of(task, info, index, time_ns))
            for task, info, (index, time_ns, _), maps in zip(
                tasks, infos, instant, cameras.heat_maps(pictures), strict=True
            )
        ]
        pipe.send(("messages", messages))
    if not done:
        names = ", ".join(f"{task.place} has no picture after the first {task.skip}" for task in tasks)
        pipe.send(("error", names))
    pipe.send(("end", None))


@contextlib.contextmanager
def _naming(task: CameraTask) -> Iterator[None]:
    """Tell what goes wrong with a source with the camera's name."""
    try:
        yield
    except DeviceError as error:
        raise CameraError(f"camera '{task.name}': {error}") from error


def _pictures(task: CameraTask, source: PictureSource) -> Iterator[tuple[int, int, Picture]]:
    """Yield index, instant in ns and picture, after those that are left out."""
    with _naming(task):
        for index, (time_ns, picture) in enumerate(source):
            if index >= task.skip:
                yield index, time_ns, picture


def instant_of(task: CameraTask, info: PictureInfo, index: int, time_ns: int) -> tuple[int, int]:
    """Return sequence and time of a picture.

    Live, the sequence counts intervals since the epoch: cameras of one clock then agree on it.
    """
    if info.count is None:
        return round(time_ns * info.rate_hz * 1e-9) % (1 << 32), time_ns
    return index - task.skip, time_ns - round(task.skip * 1e9 / info.rate_hz)


def messages_of(
    people: Mapping[int, CameraHeatMaps | None], task: CameraTask, sequence: int, time_ns: int
) -> bytes:
    """Return the heat maps of one picture as they go over the wire, by number of the person; of nobody,
    too."""
    shown = list(people.items()) or [(0, None)]
    return b"".join(
        encoded_maps(
            task.name, task.network, sequence, time_ns, maps, person=number, following=len(shown) - 1 - k
        )
        for k, (number, maps) in enumerate(shown)
    )
