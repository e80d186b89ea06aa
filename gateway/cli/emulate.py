"""``mocap-gateway emulate``: a suit without the hardware."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from devices.emulators.delivery import Encoding, Transmission
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import PRESETS
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import (
    CanBusTransport,
    PtyTransport,
    SlcanTransport,
    TcpTransport,
    Transport,
)
from devices.link import Framing, gateway_time_ns
from gateway.body.rig import load_rig
from gateway.cli.emulated_rig import dress, move
from gateway.errors import GatewayError, nearest

_START_DELAY_NS = 500_000_000


class Medium(StrEnum):
    """Where the emulated suit speaks."""

    PTY = "pty"
    TCP = "tcp"
    SLCAN = "slcan"
    CAN = "can"


def emulate(
    rig: Annotated[str, typer.Option(help="Rig to wear: a shipped one or a file.")] = "suit_17",
    on: Annotated[
        Medium, typer.Option(help="What to speak on.")
    ] = Medium.PTY,
    link: Annotated[
        Path | None, typer.Option(help="pty, slcan: make this link to the port.")
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="tcp: listen here (0: a free port).")
    ] = 7000,
    channel: Annotated[str, typer.Option(help="can: SocketCAN interface.")] = "vcan0",
    fd: Annotated[bool, typer.Option("--fd", help="can, slcan: CAN FD frames.")] = False,
    imperfections: Annotated[str, typer.Option(help=f"How bad it is: {', '.join(PRESETS)}.")] = "typical",
    rate: Annotated[float, typer.Option(min=1, max=4000, help="Samples of each module a second.")] = 100.0,
    relay: Annotated[
        bool, typer.Option(help="Through a relay that batches (not on CAN).")
    ] = True,
    fine: Annotated[bool, typer.Option("--fine", help="Send the fine (32-bit) samples.")] = False,
    seed: Annotated[int, typer.Option(help="Of the motion and of everything random.")] = 1,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after so long.")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Say where and since when as JSON.")
    ] = False,
) -> None:
    """Emulate a suit: a moving body, its sensors with their errors, the modules' protocol.

    A human walks, a pendulum swings, anything else moves its joints at random; --seed makes it
    repeatable.
    """
    if imperfections not in PRESETS:
        raise GatewayError(
            f"--imperfections {imperfections}: no such preset{nearest(imperfections, PRESETS)}"
        )
    suit = load_rig(rig)
    is_can = on in {Medium.CAN, Medium.SLCAN}
    settings = SuitSettings(
        sampling_rate_hz=rate,
        is_fine=fine,
        has_relay=relay and not is_can,
        encoding=Encoding(Framing.CAN if is_can else Framing.BYTE_STREAM, fd),
        gravity=suit.gravity,
        magnetic_field=suit.magnetic_field,
    )
    motion = move(dress(suit), suit.skeleton.name, seed)
    traffic = SuitTraffic(motion, settings, PRESETS[imperfections], seed)
    _play(traffic.transmissions(seconds), _transport(on, link, port, channel, fd), as_json)


def _transport(on: Medium, link: Path | None, port: int, channel: str, fd: bool) -> Transport:
    if on is Medium.TCP:
        return TcpTransport(port)
    if on is Medium.CAN:
        return CanBusTransport(channel, "socketcan", fd=fd)
    return PtyTransport(link) if on is Medium.PTY else SlcanTransport(link)


def _play(source: Iterable[Transmission], transport: Transport, as_json: bool) -> None:
    suit = EmulatedSuit(source, transport, start_ns=gateway_time_ns() + _START_DELAY_NS)
    try:
        asyncio.run(_run(suit, as_json))
    except KeyboardInterrupt:
        pass
    except OSError as error:
        raise GatewayError(f"the emulated suit cannot start: {error}") from error
    if not as_json:
        counts = suit.counts
        Console().print(
            f"sent {counts.sent_bytes} bytes; {counts.dropped_bytes} dropped because nobody read them"
        )


async def _run(suit: EmulatedSuit, as_json: bool) -> None:
    task = asyncio.ensure_future(suit.run())
    while (url := url_of(suit.transport)) is None and not task.done():
        await asyncio.sleep(0.01)  # noqa: ASYNC110 - a transport has no event of being open
    if url is not None:
        if as_json:
            typer.echo(json.dumps({"url": url, "start_ns": suit.start_ns}))
        else:
            Console().print(f"emulated suit on [bold]{url}[/bold]  (Ctrl-C ends it)", soft_wrap=True)
    await task


def url_of(transport: Transport) -> str | None:
    """What a gateway's link is to be called to read this; None before it is open."""
    if isinstance(transport, TcpTransport):
        return f"tcp://127.0.0.1:{transport.port}" if transport.port else None
    if isinstance(transport, PtyTransport):
        return transport.path or None
    if isinstance(transport, SlcanTransport):
        return f"slcan://{transport.path}" if transport.path else None
    return "can://socketcan"
