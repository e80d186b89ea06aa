"""The people of a film: of each a message a camera and instant, from the film's first instant on."""

from __future__ import annotations

from collections.abc import Sequence

from gateway.body.skeleton import VideoSetUp
from gateway.cameras.live_crowd import CrowdInstant
from gateway.sources.heat_maps import encoded_maps

Instants = list[list[bytes]]
"""Messages of one person: of every instant, one a camera."""


class FilmedPeople:
    """Puts together what the instants of a film bring; where somebody is not there, cameras show nobody."""

    def __init__(self, video: VideoSetUp, rate_hz: float) -> None:
        self.video = video
        self.taken = 0
        """Instants, those too in which nobody was looked for."""
        self._absent: dict[int, int] = {}
        self._rate_hz = rate_hz
        self._people: dict[int, Instants] = {}

    def add(self, instant: CrowdInstant) -> None:
        """Add one instant."""
        self.taken += 1
        for number, messages in instant.messages.items():
            self._extend(number, [messages])
        for number, instants in instant.before.items():
            self._extend(number, instants)
        self._absent.update(dict.fromkeys(instant.before, 0))
        self._absent.update(instant.absent)

    @property
    def people(self) -> list[Instants]:
        """By person, in the order in which they entered; until they were last there."""
        return [
            messages[: len(messages) - self._absent.get(number, 0)]
            for number, messages in self._people.items()
        ]

    def time_ns(self, index: int) -> int:
        """Return when an instant is, since the film's first."""
        return round(index * 1e9 / self._rate_hz)

    def _extend(self, number: int, instants: Sequence[Sequence[bytes]]) -> None:
        """Add instants of somebody that end at the newest one, and before them those without the person.

        They take the place of those in which somebody who is back had not been given up.
        """
        person = self._people.setdefault(number, [])
        del person[self.taken - len(instants) :]
        absent = range(len(person), self.taken - len(instants))
        person += [self._nobody(index) for index in absent]
        person += [list(each) for each in instants]

    def _nobody(self, index: int) -> list[bytes]:
        time_ns = self.time_ns(index)
        return [
            encoded_maps(camera.name, self.video.network, index, time_ns, None)
            for camera in self.video.cameras
        ]
