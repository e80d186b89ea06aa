"""What is looked at, in which order; this computer itself at the end."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from devices.endpoints import link_from_url
from devices.link import SUIT
from devices.replay_link import is_recording
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.doctor import running
from gateway.doctor.broker import broker, camera_topic, is_at_broker
from gateway.doctor.findings import Finding, Surroundings, Verdict, bad, good, warning
from gateway.doctor.links import can_interface, capacity, latency, listen, naming, opening
from gateway.doctor.named_files import trouble_with_files
from gateway.errors import SettingsError
from gateway.settings import (
    GatewaySettings,
    MetricsSettings,
    RecordingSettings,
    fitting_suit,
    load_gateway_settings,
)
from gateway.sources.link_settings import LinkSettings
from gateway.sources.registry import source_kind
from gateway.support.processor import target_name

_MB = 1e6


def disk(settings: RecordingSettings, surroundings: Surroundings) -> Finding:
    """Return whether there is room where recordings go."""
    folder = Path(settings.folder).absolute()
    # The folder may be made later: what counts is the deepest one that is there.
    present = next(each for each in (folder, *folder.parents) if each.exists())
    if not present.is_dir() or not os.access(present, os.W_OK | os.X_OK):
        found = f"{present} cannot be written by this user"
        return bad("disk", found, f"sudo chown $USER {present}, or another recording.folder")
    free_mb = surroundings.free_bytes(present) / _MB
    found = f"{free_mb:,.0f} MB free for recordings in {folder}"
    remedy = "delete or move recordings, or choose another recording.folder"
    if free_mb < settings.min_free_mb:
        least = f"recording stops below {settings.min_free_mb:,.0f} MB (recording.min_free_mb)"
        return bad("disk", f"{found}: {least}", remedy)
    if free_mb < settings.warn_free_mb:
        return warning("disk", found, remedy)
    return good("disk", found)


def kernels(method: str) -> Iterator[Finding]:
    """Yield whether the method's kernels are compiled."""
    from gateway.service import readiness  # noqa: PLC0415 - it imports the whole pipeline

    if method not in readiness.LONG_COMPILED:
        return
    found = readiness.readiness(method)
    text = f"'{method}': {readiness.in_words(found)}, for {target_name()}"
    if found.is_complete:
        yield good("kernels", text)
    else:
        remedy = f"mocap-gateway kernels build {method}; else the first start compiles them"
        yield warning("kernels", text, remedy)


def metrics_port(settings: MetricsSettings, *, gateway_runs: bool) -> Iterator[Finding]:
    """Yield whether the port of the metrics is free, or taken by the running gateway."""
    if not settings.port:
        return
    where = f"{settings.host}:{settings.port}"
    with socket.socket() as probe:
        # As servers do: a port in TIME_WAIT is free for them.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            if gateway_runs:
                yield good("metrics", f"{where} is taken, by the running gateway")
            else:
                remedy = "another metrics.port, or stop what listens there (ss -ltnp)"
                yield bad("metrics", f"{where} cannot be listened on ({error.strerror})", remedy)
            return
    yield good("metrics", f"{where} is free")


LISTEN_S = 2.0


def examine_file(
    config: Path, rate_hz: float | None = None, listen_s: float = LISTEN_S, here: Surroundings | None = None
) -> Iterator[Finding]:
    """Yield the file itself, then all that it names. rate_hz: of each module; none: as assembled."""
    try:
        settings = load_gateway_settings(config)
        load_rig(settings.rig, config)
    except SettingsError as error:
        for line in str(error).splitlines():
            yield bad("configuration", line, "correct it; what may stand there: mocap-gateway config schema")
        return
    yield good("configuration", f"{config} is well-formed")
    for trouble in trouble_with_files(settings, load_rig(settings.rig, config), config):
        found, _, remedy = trouble.rpartition(": ")
        yield bad("files", found, remedy)
    yield from examine(settings, config, rate_hz or settings.assembly.rate_hz, listen_s, here)


def _method(settings: GatewaySettings, suit: WornSuit) -> str:
    """Return the method that would run; where the suit has no use for a link, the one that is named."""
    try:
        return fitting_suit(settings, suit).reconstructor
    except SettingsError:
        return settings.reconstructor


def examine(
    settings: GatewaySettings,
    config: Path,
    rate_hz: float,
    listen_s: float = LISTEN_S,
    here: Surroundings | None = None,
) -> Iterator[Finding]:
    """Look at everything a configuration names. rate_hz: samples of each module a second.

    Opens each port, reads it for ``listen_s`` seconds (0: not at all) and asks modules who they are; connects
    to the broker; changes nothing. Raises ``SettingsError`` for a rig that is wrong.
    """
    here = here or Surroundings()
    suit = load_rig(settings.rig, config)
    yield good("rig", f"{len(suit.module_ids)} modules on body '{suit.skeleton.name}'")
    yield from kernels(_method(settings, suit))
    # A gateway that runs has the ports open: it is asked instead of the modules.
    states = asyncio.run(running.module_states(settings.mqtt, settings.gateway))
    readable = []
    for link in settings.links:
        if is_at_broker(link):
            yield from asyncio.run(camera_topic(link, settings.mqtt, listen_s))
            continue
        opened = asyncio.run(opening(link, gateway_runs=states is not None))
        yield opened
        yield from naming(link, here)
        yield from latency(link, here)
        yield from can_interface(link, here)
        if link.carries == SUIT:
            yield from capacity(link.name, link.url, len(suit.module_ids), rate_hz)
        # Only links that opened are listened to; the others have their finding already.
        if opened.verdict is Verdict.GOOD and _has_modules(link):
            readable.append(link)
    yield from asyncio.run(broker(settings.mqtt, settings.gateway, here))
    if states is not None:
        yield from running.judge(settings.gateway, states)
    else:
        yield from _listen(readable, suit, listen_s, rate_hz, _method(settings, suit))
    yield disk(settings.recording, here)
    yield from metrics_port(settings.metrics, gateway_runs=states is not None)


def _listen(
    links: list[LinkSettings], suit: WornSuit, seconds: float, rate_hz: float, method: str
) -> list[Finding]:
    return asyncio.run(listen(links, suit, seconds, rate_hz, method)) if links and seconds else []


def _has_modules(link: LinkSettings) -> bool:
    """Return whether modules are at the other end: no receiver, no cameras, no file."""
    has_modules = source_kind(link.carries).has_modules
    return has_modules and not is_recording(link_from_url(link.url))
