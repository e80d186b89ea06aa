"""What stands between a configuration and a running suit: findings, each with its remedy."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from devices.endpoints import link_from_url
from devices.line_rate import CanRate, UartRate, line_rate
from devices.link import LinkError
from devices.replay_link import ReplayLink
from firmware_protocol import InertialSample
from firmware_protocol.capacity import Traffic, can_load, uart_load
from gateway.body.rig import load_rig
from gateway.settings import GatewaySettings, LinkSettings

COMFORTABLE = 0.7
"""Share of a line above which bursts, retries and commands begin to wait."""
_BROKER_TIMEOUT_S = 2.0
_FULL_SAMPLE = InertialSample((0.0, 0.0, 9.8), (20.0, 0.0, -40.0), (0.0, 0.0, 0.0))


class Verdict(StrEnum):
    """How bad a finding is."""

    GOOD = "good"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at."""

    subject: str
    verdict: Verdict
    found: str
    remedy: str = ""


def examine(settings: GatewaySettings, config: Path, rate_hz: float) -> Iterator[Finding]:
    """Look at everything a configuration names. rate_hz: samples of each module a second.

    Opens each port for a moment and connects to the broker; changes nothing. Raises
    ``SettingsError`` for a rig that is wrong.
    """
    suit = load_rig(settings.rig, config)
    n_modules = len(suit.module_ids)
    yield Finding("rig", Verdict.GOOD, f"{n_modules} modules on body '{suit.skeleton.name}'")
    for link in settings.links:
        yield asyncio.run(_port(link))
        yield from capacity(link.name, link.url, n_modules, rate_hz)
    yield _broker(settings)


def capacity(name: str, url: str, n_modules: int, rate_hz: float) -> Iterator[Finding]:
    """Whether the link's line carries so many modules (accelerometer, magnetometer and gyrometer each)."""
    rate = line_rate(url)
    if rate is None:
        return
    traffic = [Traffic(_FULL_SAMPLE, n_modules, rate_hz)]
    if isinstance(rate, CanRate):
        load = can_load(traffic, rate.bitrate, rate.data_bitrate)
        line = f"CAN at {rate.bitrate:,} bit/s" + (f", FD {rate.data_bitrate:,}" if rate.data_bitrate else "")
        remedy = (
            "use CAN FD (fd=1), a higher bitrate, a second bus"
            if rate.data_bitrate is None
            else "a second bus"
        )
    else:
        load = uart_load(traffic, rate.baud)
        line = f"serial at {rate.baud:,} baud"
        remedy = _uart_remedy(traffic, rate)
    found = f"{n_modules} modules × {rate_hz:g} Hz take {load:.0%} of {line}"
    if load <= COMFORTABLE:
        yield Finding(f"{name}: capacity", Verdict.GOOD, found)
        return
    verdict = Verdict.BAD if load > 1 else Verdict.WARNING
    yield Finding(
        f"{name}: capacity", verdict, found, f"{remedy}, or at most {rate_hz * COMFORTABLE / load:.0f} Hz"
    )


def _uart_remedy(traffic: list[Traffic], rate: UartRate) -> str:
    with_relay = uart_load(traffic, rate.baud, has_relay=True)
    needed = uart_load(traffic, 1) / COMFORTABLE
    return f"at least {needed:,.0f} baud, a relay that batches ({with_relay:.0%})"


async def _port(link: LinkSettings) -> Finding:
    subject = f"{link.name}: port"
    opened = link_from_url(link.url, name=link.name)
    try:
        await opened.open()
    except LinkError as error:
        found, _, remedy = str(error).partition("; ")
        return Finding(subject, Verdict.BAD, found, remedy)
    await opened.close()
    what = "recording can be read" if isinstance(opened, ReplayLink) else "can be opened"
    return Finding(subject, Verdict.GOOD, f"{link.url} {what}")


def _broker(settings: GatewaySettings) -> Finding:
    mqtt = settings.mqtt
    if mqtt.broker == "embedded":
        return Finding("broker", Verdict.GOOD, f"embedded, on port {mqtt.port}")
    try:
        socket.create_connection((mqtt.host, mqtt.port), timeout=_BROKER_TIMEOUT_S).close()
    except OSError as error:
        remedy = "start mosquitto, correct mqtt.host and mqtt.port, or say 'broker: embedded'"
        return Finding("broker", Verdict.BAD, f"nobody answers at {mqtt.host}:{mqtt.port} ({error})", remedy)
    return Finding("broker", Verdict.GOOD, f"{mqtt.host}:{mqtt.port} answers")
