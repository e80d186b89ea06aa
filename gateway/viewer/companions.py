"""Others before the same cameras, or with markers in one room, drawn beside whom the page is about."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence

import viser

from devices.link import gateway_time_ns
from gateway.contract.messages import BodyMessage
from gateway.outputs.subscriber import PoseSubscriber, ReceivedPose
from gateway.viewer.pose_table import STALE_AFTER_S
from gateway.viewer.posture import PostureKeeper, skeleton_of
from gateway.viewer.scene import BodyScene
from gateway.viewer.stage import ViewerStage

_NUMBERED = re.compile(r"(.+)_(\d+)")
MOST = 8
_ABOVE_M = 0.3
"""Of a name over the highest joint, which is the head's lower end where somebody stands."""


class _Companion:
    """One of them."""

    def __init__(self, server: viser.ViserServer, stage: ViewerStage, name: str, body: BodyMessage) -> None:
        skeleton = skeleton_of(body)
        self.body = body
        self._stage = stage
        self._keeper = PostureKeeper(skeleton)
        self._scene = BodyScene(server, stage, skeleton, root=f"/companions/{name}")
        self._label = server.scene.add_label(f"/companions/{name}/name", name, anchor="bottom-center")

    def remove(self) -> None:
        """Take it off the page."""
        self._scene.remove()
        self._label.remove()

    def draw(self, received: ReceivedPose) -> None:
        """Bring it to a pose, every time: its place on the page depends on the page's middle too."""
        posture = self._keeper.take(received.pose)
        self._scene.draw(posture, is_stale=False)
        p_w = posture.p_w - self._stage.middle
        x, y, _ = p_w.mean(axis=0)
        self._label.position = (x, y, p_w[:, 2].max() + _ABOVE_M)


class Companions:
    """A body, below its name, for each person who gives poses: ``lab_2`` and ``lab_3`` beside ``lab_1``.

    Of people with markers it is ``lab_eve`` beside ``lab``.
    """

    def __init__(self, server: viser.ViserServer, stage: ViewerStage) -> None:
        self._server, self._stage = server, stage
        self._latest: dict[str, ReceivedPose] = {}
        self._drawn: dict[str, _Companion] = {}
        self._marked: frozenset[str] = frozenset()

    def add(self, received: ReceivedPose) -> None:
        """Take a pose of anybody."""
        name = received.gateway
        is_wanted = name in self._marked or _NUMBERED.fullmatch(name) is not None
        if is_wanted and (name in self._latest or len(self._latest) <= MOST):
            self._latest[name] = received

    def draw(
        self, beside: str, bodies: Mapping[str, BodyMessage], marked: Collection[str] = frozenset()
    ) -> None:
        """Draw all but the person that the page is about, and remove whoever gives no poses any more.

        beside: name of that person's gateway; bodies: by name, as they were published; marked: names of those
        that publish markers.
        """
        self._marked = frozenset(marked)
        oldest_ns = gateway_time_ns() - round(STALE_AFTER_S * 1e9)
        self._latest = {name: each for name, each in self._latest.items() if each.received_ns > oldest_ns}
        room = room_of(beside, marked)
        shown = {
            name: each
            for name, each in self._latest.items()
            if name != beside and name in bodies and room is not None and room_of(name, marked) == room
        }
        for name, companion in list(self._drawn.items()):
            if name not in shown or companion.body != bodies[name]:
                companion.remove()
                del self._drawn[name]
        for name, received in shown.items():
            if name not in self._drawn:
                self._drawn[name] = _Companion(self._server, self._stage, name, bodies[name])
            self._drawn[name].draw(received)


def people_of(poses: PoseSubscriber, gateway: str) -> Sequence[object] | None:
    """Return the numbers of the people before the cameras of a gateway, or of somebody's gateway; None: it
    follows no people."""
    health = poses.healths.get(room_of(gateway) or gateway)
    people = None if health is None else health.statistics.get("people")
    present = people.get("present") if isinstance(people, Mapping) else None
    return present if isinstance(present, list) else None


def room_of(gateway: str, marked: Collection[str] = frozenset()) -> str | None:
    """Return the name that people before the same cameras, or with markers in one room, share.

    marked: names of those that publish markers. None for one who is neither numbered nor marked.
    """
    if gateway in marked:
        return min((each for each in marked if f"{gateway}_".startswith(f"{each}_")), key=len)
    found = _NUMBERED.fullmatch(gateway)
    return found[1] if found else None
