"""A recording played through the service: what subscribers see is what they saw, or saw faster."""

from __future__ import annotations

import asyncio
import contextlib
import json

import typer

from devices.marker_file_link import MarkerFileLink
from devices.replay_link import ReplayLink
from gateway.cli.progress import progress_bar
from gateway.cli.run import until_signal
from gateway.recording import Recording
from gateway.recording.solving import Source, with_recorded_table
from gateway.service.service import Service

QUEUE = 512
"""Poses that may wait for the broker; reading goes on while no more than half of them do."""
_POLL_S = 0.002
_REFRESH_S = 0.1


def replay_live(
    recording: Recording, source: Source, speed: float | None, *, embedded: bool, as_json: bool
) -> None:
    """Play until the end or Ctrl-C. Waits for the broker first; at full speed for its subscribers too."""
    mqtt = source.settings.mqtt
    changes: dict[str, object] = {"queue_length": max(mqtt.queue_length, QUEUE)}
    if embedded:
        changes.update(broker="embedded", host="127.0.0.1")
    kept = source.settings.recording.model_copy(update={"at_start": False})
    settings = source.settings.model_copy(update={"mqtt": mqtt.model_copy(update=changes), "recording": kept})
    link = ReplayLink(recording.meta.path, speed=speed)
    with with_recorded_table(recording, settings) as complete:
        service = Service(complete, source.suit, [link])
    link.hold = Brake(service, is_paced=speed is not None).hold
    typer.echo(f"playing to {mqtt.base_topic}/{settings.gateway}/pose; Ctrl-C ends", err=True)
    asyncio.run(play(service, link, as_json))
    tell_outcome(service, as_json)


def tell_outcome(service: Service, as_json: bool) -> None:
    """Print how many poses were made, published and dropped."""
    counters = service.mqtt.counters
    outcome = {"poses": service.pipeline.skeleton_frames, "published": counters.published}
    outcome["dropped"] = counters.dropped
    if as_json:
        typer.echo(json.dumps(outcome))
    else:
        typer.echo("{poses} poses, {published} published, {dropped} dropped".format(**outcome))


class Brake:
    """Holds the reading up until the broker is there, and at full speed while it has fallen behind."""

    def __init__(self, service: Service, *, is_paced: bool) -> None:
        self._mqtt = service.mqtt
        self._is_paced = is_paced
        self._has_begun = False

    async def hold(self) -> None:
        """Return when reading may go on."""
        await asyncio.sleep(0)
        while not self._may_go_on():  # noqa: ASYNC110 - two conditions of others, neither an event
            await asyncio.sleep(_POLL_S)
        self._has_begun = True

    def _may_go_on(self) -> bool:
        if self._is_paced and self._has_begun:
            return True
        return self._mqtt.is_connected and self._mqtt.counters.queued <= QUEUE // 2


async def play(service: Service, link: ReplayLink | MarkerFileLink, as_json: bool) -> None:
    """Run the service until the link has come to its end, with a progress bar."""
    running = asyncio.ensure_future(until_signal(service))
    with progress_bar("playing", is_shown=not as_json) as tell, contextlib.suppress(asyncio.CancelledError):
        while not running.done():
            tell(link.position, link.size)
            await asyncio.wait({running}, timeout=_REFRESH_S)
        await running
