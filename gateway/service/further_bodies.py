"""Further people beside the first one, each with a service of its own: those before one optical system are
fed with what the links of the first service give."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.errors import SettingsError
from gateway.outputs.settings import OutputsSettings
from gateway.settings import BodySettings, GatewaySettings, MetricsSettings
from gateway.sources.link_settings import LinkSettings

log = logging.getLogger(__name__)

_MOST_WAITING = 2000
"""Chunks that wait for a body that is not solved fast enough; then the newest are left out."""

FurtherBody = tuple[GatewaySettings, WornSuit]


def further_bodies(settings: GatewaySettings, config: Path | None = None) -> list[FurtherBody]:
    """Return the settings and the subject of each of ``bodies``, whose files may lie beside ``config``.

    Raises ``SettingsError`` for a subject without markers, and as ``load_rig`` does.
    """
    return [(_settings_of(settings, body), _subject_of(body, config)) for body in settings.bodies]


def _subject_of(body: BodySettings, config: Path | None) -> WornSuit:
    suit = load_rig(body.subject, config)
    if suit.markers is None:
        raise SettingsError(
            f"bodies: {body.name}: '{body.subject}' is no subject with markers: name a file of `optical fit`"
        )
    return suit


def _settings_of(settings: GatewaySettings, body: BodySettings) -> GatewaySettings:
    """Return those of one further body, with the links of markers."""
    links = [
        link.model_copy(update={"person": body.person})
        for link in settings.links
        if link.carries == "markers"
    ]
    return beside(settings, body.name, links).model_copy(update={"rig": body.subject})


def beside(
    settings: GatewaySettings, name: str, links: Sequence[LinkSettings], broker_port: int | None = None
) -> GatewaySettings:
    """Return the settings of one more person: a name of its own, no other outputs and ports.

    broker_port: of the broker that runs already; None: it is told later, with ``at_broker``.
    """
    # What belongs to the whole set-up stays with the first person's service: two could not bind one port.
    kept = settings.recording
    changes = {
        "gateway": f"{settings.gateway}_{name}",
        "links": list(links),
        "bodies": [],
        "outputs": OutputsSettings(),
        "metrics": MetricsSettings(),
        "recording": kept.model_copy(update={"name": name if kept.name is None else f"{kept.name}_{name}"}),
        # A broker hangs up on the older of two connections with one client id.
        "mqtt": settings.mqtt.model_copy(update={"client_id": None}),
    }
    found = settings.model_copy(update=changes)
    return found if broker_port is None else at_broker(found, broker_port)


def at_broker(settings: GatewaySettings, port: int) -> GatewaySettings:
    """Return the settings with the broker that the first body's service has started, or found, at
    ``port``."""
    changes: dict[str, object] = {"broker": "external", "port": port, "websocket_port": None}
    return settings.model_copy(update={"mqtt": settings.mqtt.model_copy(update=changes)})


class HandedLink:
    """A link whose chunks another service reads, and hands on."""

    framing = Framing.BYTE_STREAM

    def __init__(self, name: str) -> None:
        self.name = name
        self.left_out = 0
        """Chunks that came while too many waited."""
        self._waiting: asyncio.Queue[Chunk] = asyncio.Queue(_MOST_WAITING)

    def hand(self, chunk: Chunk) -> None:
        """Take a chunk, without waiting."""
        try:
            self._waiting.put_nowait(chunk)
        except asyncio.QueueFull:
            self.left_out += 1
            if self.left_out == 1:
                log.warning("%s: chunks are left out: this machine does not keep up", self.name)

    @property
    def is_empty(self) -> bool:
        """Whether all that was handed over has been taken."""
        return self._waiting.empty()

    async def open(self) -> None:
        """Do nothing: the first person's service has opened the link."""

    async def __aiter__(self) -> AsyncIterator[Chunk]:
        while True:
            yield await self._waiting.get()

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Discard the bytes: an optical system takes no commands."""

    async def close(self) -> None:
        """Do nothing: the first person's service closes the link."""
