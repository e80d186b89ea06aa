"""``mocap-gateway emulate``: a suit without the hardware."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import takewhile
from math import radians
from pathlib import Path
from typing import NamedTuple

import can
import numpy as np
import typer
from rich.console import Console

from devices.calibration_script import begin_of_script
from devices.emulators.bodies import FloatArray
from devices.emulators.calibrating import strapped_on
from devices.emulators.delivery import Encoding, Transmission
from devices.emulators.emulated_suit import Conversation, EmulatedSuit
from devices.emulators.fault_plan import FaultPlan
from devices.emulators.faulty_suit import FaultySuit, pull_cable
from devices.emulators.gnss_receiver import FORMATS, GnssEmulation, gnss_traffic
from devices.emulators.imperfections import PRESETS
from devices.emulators.recording_formats import READERS
from devices.emulators.recordings import Recording, play
from devices.emulators.sampling import FUSED, RAW, TRIGGERED
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import (
    CanBusTransport,
    PtyTransport,
    SignedTcpTransport,
    SignedUdpTransport,
    SlcanTransport,
    TcpTransport,
    Transport,
    UdpTransport,
)
from devices.link import Framing, gateway_time_ns
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.cli import emulate_options as options
from gateway.cli.emulate_options import Medium, MotionKind, SamplingMode, StrapOn
from gateway.cli.terminal import TypedLines
from gateway.emulation.rig import calibrate, dress, move_about, sunlight, tumble, worn_wrong
from gateway.errors import GatewayError, nearest
from gateway.frames import Quantity
from gateway.support.settings_files import load_settings


def faulty(traffic: SuitTraffic, path: Path) -> FaultySuit:
    """A suit with the faults of a file. Raises ``GatewayError`` naming file and field."""
    try:
        return FaultySuit(traffic, load_settings(path, FaultPlan))
    except KeyError as error:
        raise GatewayError(f"{path}: {error.args[0]}") from error


def plan_of(source: object) -> FaultPlan:
    """What goes wrong with a source of transmissions: nothing, unless it is a faulty suit."""
    return source.plan if isinstance(source, FaultySuit) else FaultPlan()


def told(source: object) -> str:
    """What befell a suit, for whoever started it."""
    if not isinstance(source, FaultySuit):
        return ""
    befell = ", ".join(f"{kind} {count}" for kind, count in sorted(source.counts.items()))
    return f"; faults: {befell or 'none'}"


Companion = Callable[[int], EmulatedSuit]
"""Of the instant at which the motion starts, ns of gateway time."""


def without_position_devices(suit: WornSuit) -> WornSuit:
    """The suit without the local devices whose part the satellite receiver plays."""
    kept = tuple(d for d in suit.local_devices if d.quantity not in {Quantity.POSITION, Quantity.VELOCITY})
    return replace(suit, local_devices=kept)


def companion(rig: str, seed: int, link: Path, kind: str, seconds: float | None) -> Companion:
    """The receiver, to be started with the suit. Raises ``GatewayError`` for an unknown format."""
    if kind not in FORMATS:
        raise GatewayError(f"--gnss-format {kind}: unknown{nearest(kind, FORMATS)}")
    path = _path(load_rig(rig), seed)
    emulation = GnssEmulation(kind=kind)

    def start(start_ns: int) -> EmulatedSuit:
        traffic: Iterable[Transmission] = gnss_traffic(path, start_ns, emulation, seed)
        if seconds is not None:
            traffic = takewhile(lambda sent: sent.time_s < seconds, traffic)
        return EmulatedSuit(traffic, PtyTransport(link), start_ns=start_ns)

    return start


def _path(suit: WornSuit, seed: int) -> Callable[[float], tuple[FloatArray, FloatArray]]:
    """Of the root's local device that measures position (its joint, if there is none)."""
    motion = move_about(dress(without_position_devices(suit)), suit.skeleton.name, seed)
    positions = [d.position for d in suit.local_devices if d.segment == 0 and d.quantity is Quantity.POSITION]
    arm = positions[0] if positions else np.zeros(3)
    step = 1e-3

    def place(t: float) -> tuple[FloatArray, FloatArray]:
        state = motion.state(np.array([t - step, t, t + step]))
        places = state.joint_position[:, 0] + state.R_wb[:, 0] @ arm
        return places[1], (places[2] - places[0]) / (2.0 * step)

    return place


_SOON_S = 0.2
"""So long after it was typed: samples until then have been computed already."""

_SHAKEN_S = 1.5

EXPLANATION = (
    "type shake NAME, tap NAME or press NAME (its button) and Enter; NAME: a segment, or a module by its "
    "number in the rig"
)


_DEEDS: dict[str, tuple[str, Callable[[SuitTraffic, int | str, float], None]]] = {
    "shake": ("is shaken", lambda traffic, which, at_s: traffic.shake(which, at_s, _SHAKEN_S)),
    "tap": ("is tapped", lambda traffic, which, at_s: traffic.tap(which, at_s)),
    "press": ("has its button pressed", lambda traffic, which, at_s: traffic.press_button(which, at_s)),
}


def touchable(source: object) -> SuitTraffic | None:
    """Return the suit behind a source of transmissions; None: a recording, which only plays."""
    if isinstance(source, FaultySuit):
        return source.traffic
    return source if isinstance(source, SuitTraffic) else None


async def obey_typed_lines(suit: EmulatedSuit, traffic: SuitTraffic, *, is_quiet: bool) -> None:
    """Do what is typed, until the end of the input. Returns at once for a program in the background.

    is_quiet: say only what was not understood.
    """
    # In the background of a terminal, reading it would stop the whole program.
    signal.signal(signal.SIGTTIN, signal.SIG_IGN)
    lines = TypedLines()
    while (line := await lines.next()) is not None:
        said, is_done = _do(line, suit, traffic) if line else (EXPLANATION, False)
        if not (is_quiet and is_done):
            typer.echo(said, err=not is_done)


def _do(line: str, suit: EmulatedSuit, traffic: SuitTraffic) -> tuple[str, bool]:
    """Return what to say, and whether something is done."""
    deed, _, name = line.partition(" ")
    if deed not in _DEEDS:
        return f"'{deed}' is unknown; {EXPLANATION}", False
    which: int | str = int(name) if name.isdecimal() else "_".join(name.split())
    try:
        device = traffic.device(which)
    except KeyError:
        worn = map(str, traffic.motion.body.segment_names)
        return f"no module is on '{name.strip()}'{nearest(str(which), worn)}", False
    says, act = _DEEDS[deed]
    suit.do(lambda: act(traffic, which, suit.motion_time_s(gateway_time_ns()) + _SOON_S))
    return f"module {device.module_id} ({device.unique_id.hex()}) {says}", True


_START_DELAY_NS = 500_000_000


class _Wearing(NamedTuple):
    """How the suit is worn, and what is done in it."""

    is_tumbling: bool
    motion: MotionKind
    strap_on: StrapOn
    facing: float
    upside_down: tuple[int, ...]
    swapped: tuple[int, ...]


_MODES = {SamplingMode.FUSED: FUSED, SamplingMode.RAW: RAW, SamplingMode.TRIGGERED: TRIGGERED}

_REMEDIES = {
    Medium.PTY: "name another place with --link",
    Medium.SLCAN: "name another place with --link",
    Medium.TCP: "is the port taken? name another one with --port",
    Medium.UDP: "correct --host",
    Medium.CAN: "make a virtual bus with: ip link add dev vcan0 type vcan; ip link set vcan0 up; "
    "a kernel without CAN can use --on slcan",
}


def emulate(
    rig: options.Rig = "suit_17",
    on: options.On = Medium.PTY,
    link: options.Link = None,
    port: options.Port = 7000,
    host: options.Host = "127.0.0.1",
    channel: options.Channel = "vcan0",
    fd: options.Fd = False,
    key_file: options.KeyFile = None,
    imperfections: options.Imperfections = "typical",
    rate: options.Rate = 100.0,
    mode: options.Mode = SamplingMode.RAW,
    relay: options.Relay = None,
    fine: options.Fine = False,
    recording: options.Recording = None,
    kind: options.Kind = "",
    fresh: options.Fresh = 0,
    id_conflict: options.IdConflict = False,
    gnss: options.Gnss = None,
    gnss_format: options.GnssFormat = "nmea",
    faults: options.Faults = None,
    tumbling: options.Tumbling = False,
    motion: options.Motion = MotionKind.OWN,
    strap_on: options.StrappedOn = StrapOn.RIG,
    upside_down: options.UpsideDown = None,
    swapped: options.Swapped = None,
    facing: options.Facing = 0.0,
    seed: options.Seed = 1,
    seconds: options.Seconds = None,
    as_json: options.AsJson = False,
) -> None:
    """Emulate a suit: a moving body, its sensors with their errors, the modules' protocol.

    A human walks in a circle, a pendulum swings, anything else moves its joints at random; --seed makes it
    repeatable. The suit obeys a host as real modules do; a recording only plays.
    """
    encoding = Encoding(Framing.CAN if on in {Medium.CAN, Medium.SLCAN} else Framing.BYTE_STREAM, fd)
    source: Conversation | Iterable[Transmission]
    if recording is not None:
        if faults is not None:
            raise GatewayError("--faults needs a suit that moves: a recording only plays")
        source = play(_read(recording, kind), encoding)
    else:
        settings = SuitSettings(
            sampling_rate_hz=rate,
            mode=_MODES[mode],
            is_fine=fine,
            has_relay=encoding.framing is Framing.BYTE_STREAM
            and (on is not Medium.UDP if relay is None else relay),
            encoding=encoding,
        )
        wearing = _Wearing(
            tumbling, motion, strap_on, radians(facing), tuple(upside_down or ()), tuple(swapped or ())
        )
        traffic = _traffic(rig, settings, imperfections, seed, fresh, id_conflict, wearing, gnss is not None)
        source = traffic if faults is None else faulty(traffic, faults)
    receiver = None if gnss is None else companion(rig, seed, gnss, gnss_format, seconds)
    start_ns = gateway_time_ns() + _START_DELAY_NS
    if motion is MotionKind.CALIBRATION:
        start_ns = begin_of_script(start_ns)
    try:
        transport = (
            _transport(on, link, port, host, channel, fd)
            if key_file is None
            else _signed_transport(on, port, host, key_file)
        )
        _play(source, transport, as_json, seconds, receiver, start_ns)
    except (OSError, can.CanError) as error:
        raise GatewayError(f"the emulated suit cannot speak on {on}: {error}; {_REMEDIES[on]}") from error


def _traffic(
    rig: str,
    settings: SuitSettings,
    imperfections: str,
    seed: int,
    fresh: int,
    id_conflict: bool,
    wearing: _Wearing,
    has_gnss: bool,
) -> SuitTraffic:
    if imperfections not in PRESETS:
        raise GatewayError(f"--imperfections {imperfections}: unknown{nearest(imperfections, PRESETS)}")
    suit = load_rig(rig)
    if has_gnss:
        suit = without_position_devices(suit)
    ids = suit.module_ids
    world = replace(
        settings,
        gravity=suit.gravity,
        magnetic_field=suit.magnetic_field,
        sunlight=sunlight(suit, gateway_time_ns()),
        fresh=frozenset(ids[:fresh]),
        stored_ids={ids[-1]: ids[-2]} if id_conflict and len(ids) > 1 else {},
    )
    body = dress(suit)
    if wearing.strap_on is StrapOn.RANDOM:
        body = strapped_on(body, seed)
    try:
        body = worn_wrong(body, wearing.upside_down, wearing.swapped)
    except ValueError as error:
        raise GatewayError(str(error)) from error
    if wearing.motion is MotionKind.CALIBRATION:
        motion = calibrate(body, suit.skeleton.name, seed, wearing.facing)
    else:
        motion = (tumble if wearing.is_tumbling else move_about)(body, suit.skeleton.name, seed)
    return SuitTraffic(motion, world, PRESETS[imperfections], seed)


def _read(path: Path, kind: str) -> Recording:
    if kind not in READERS:
        raise GatewayError(f"--format {kind or 'is missing'}: unknown{nearest(kind, READERS)}")
    try:
        return READERS[kind](path)
    except (OSError, ValueError, KeyError) as error:
        raise GatewayError(f"{path} cannot be read as {kind}: {error}") from error


def _transport(on: Medium, link: Path | None, port: int, host: str, channel: str, fd: bool) -> Transport:
    if on is Medium.TCP:
        return TcpTransport(port)
    if on is Medium.UDP:
        return UdpTransport(port, host)
    if on is Medium.CAN:
        return CanBusTransport(channel, "socketcan", fd=fd)
    return PtyTransport(link) if on is Medium.PTY else SlcanTransport(link)


def _signed_transport(on: Medium, port: int, host: str, key_file: Path) -> Transport:
    if on not in {Medium.TCP, Medium.UDP}:
        raise GatewayError(f"--key-file: nothing is signed on {on}; take --on tcp or --on udp")
    try:
        if on is Medium.TCP:
            return SignedTcpTransport(key_file, port)
        return SignedUdpTransport(key_file, port, host)
    except ValueError as error:
        raise GatewayError(f"--key-file: {error}") from error


def _play(
    source: Conversation | Iterable[Transmission],
    transport: Transport,
    as_json: bool,
    seconds: float | None,
    receiver: Companion | None,
    start_ns: int,
) -> None:
    beside = None if receiver is None else receiver(start_ns)
    suit = EmulatedSuit(source, transport, start_ns=start_ns, duration_s=seconds)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_run(suit, beside, source, as_json))
    if not as_json:
        counts = suit.counts
        Console().print(
            f"sent {counts.sent_bytes} bytes; {counts.dropped_bytes} dropped because nobody read them"
            f"{told(source)}"
        )


async def _run(suit: EmulatedSuit, beside: EmulatedSuit | None, source: object, as_json: bool) -> None:
    runs = [suit.run()] if beside is None else [suit.run(), beside.run()]
    task = asyncio.ensure_future(asyncio.gather(*runs))
    # Else the link to the port would stay, and one day lead to another.
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup has it
            asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    companions = [asyncio.create_task(pull_cable(plan_of(source), suit))]
    while not (url := suit.transport.url) and not task.done():  # noqa: ASYNC110 - for a moment
        await asyncio.sleep(0.01)
    traffic = touchable(source)
    if url:
        _announce(url, suit, as_json, traffic is not None)
        if traffic is not None:
            companions.append(asyncio.create_task(obey_typed_lines(suit, traffic, is_quiet=as_json)))
    try:
        with contextlib.suppress(asyncio.CancelledError):
            await task
    finally:
        for companion in companions:
            companion.cancel()


def _announce(url: str, suit: EmulatedSuit, as_json: bool, is_touchable: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"url": url, "start_ns": suit.start_ns}))
        return
    Console().print(f"emulated suit on [bold]{url}[/bold]  (Ctrl-C ends it)", soft_wrap=True)
    if is_touchable and sys.stdin is not None and sys.stdin.isatty():
        Console().print(EXPLANATION)
