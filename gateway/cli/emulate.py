"""``mocap-gateway emulate``: a suit without the hardware."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import takewhile
from math import radians
from pathlib import Path
from typing import Annotated

import can
import numpy as np
import typer
from rich.console import Console
from rich.markup import escape

from devices.calibration_script import begin_of_script
from devices.emulators.bodies import FloatArray
from devices.emulators.data_sets import READERS
from devices.emulators.delivery import Encoding, Transmission
from devices.emulators.device.sampling import FUSED, RAW, TRIGGERED
from devices.emulators.emulated_suit import Conversation, EmulatedSuit
from devices.emulators.faults.fault_plan import FaultPlan
from devices.emulators.faults.faulty_suit import FaultySuit, pull_cable
from devices.emulators.gnss_receiver import FORMATS, GnssEmulation, gnss_traffic
from devices.emulators.imperfections import PRESETS
from devices.emulators.makers.registry import VENDOR_EMULATORS, announce
from devices.emulators.motion.calibrating import strapped_on
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.playback import play
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import (
    CanBusTransport,
    LinkPerDevice,
    PtyTransport,
    SignedTcpTransport,
    SignedUdpTransport,
    SlcanTransport,
    TcpTransport,
    Transport,
    UdpTransport,
)
from devices.link import Framing, gateway_time_ns
from devices.recorded_tracks import RecordedTracks
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.cli.emulate_makers import VendorSuit, emulators_of, print_links, vendor_suit_of
from gateway.cli.options import with_options
from gateway.cli.terminal import TypedLines
from gateway.emulation.rig import (
    calibrate,
    dress,
    move_about,
    perform,
    sunlight,
    tumble,
    worn_wrong,
)
from gateway.errors import GatewayError, nearest
from gateway.frames import Quantity
from gateway.support.settings_files import load_settings


class Medium(StrEnum):
    """Where the emulated suit speaks."""

    PTY = "pty"
    TCP = "tcp"
    UDP = "udp"
    SLCAN = "slcan"
    CAN = "can"


class SamplingMode(StrEnum):
    """What the modules send until a host sets them otherwise."""

    RAW = "raw"
    FUSED = "fused"
    TRIGGERED = "triggered"


class MotionKind(StrEnum):
    """What the emulated body does."""

    OWN = "own"
    CALIBRATION = "calibration"
    EVERYDAY = "everyday"


class StrapOn(StrEnum):
    """How the modules sit."""

    RIG = "rig"
    RANDOM = "random"


@dataclass(frozen=True)
class Emulation:
    """The options of ``emulate``: what is worn and how, what it does, and where it speaks."""

    rig: Annotated[str, typer.Option(help="Rig to wear: a shipped one or a file.")] = "suit_17"
    speaks: Annotated[
        str | None,
        typer.Option(
            help="Speak as modules of another maker, each on a link of its own: "
            f"{', '.join(VENDOR_EMULATORS)}."
        ),
    ] = None
    on: Annotated[Medium, typer.Option(help="What to speak on.")] = Medium.PTY
    link: Annotated[Path | None, typer.Option(help="pty, slcan: make this link to the port.")] = None
    port: Annotated[
        int,
        typer.Option(min=0, max=65535, help="tcp: listen here (0: a free port). udp: the gateway's port."),
    ] = 7000
    host: Annotated[str, typer.Option(help="udp: the gateway's address.")] = "127.0.0.1"
    channel: Annotated[str, typer.Option(help="can: SocketCAN interface.")] = "vcan0"
    fd: Annotated[bool, typer.Option("--fd", help="can, slcan: CAN FD frames.")] = False
    key_file: Annotated[
        Path | None,
        typer.Option(
            help="tcp, udp: sign with the key in this file (mocap-gateway config key), obey signed commands "
            "only."
        ),
    ] = None
    imperfections: Annotated[str, typer.Option(help=f"How bad it is: {', '.join(PRESETS)}.")] = "typical"
    rate: Annotated[float, typer.Option(min=1, max=4000, help="Samples of each module a second.")] = 100.0
    mode: Annotated[
        SamplingMode,
        typer.Option(
            help="Raw samples or orientations fused on board, or raw ones when the host triggers them."
        ),
    ] = SamplingMode.RAW
    relay: Annotated[
        bool | None,
        typer.Option(
            "--relay/--no-relay",
            help="Through a relay that batches (not on CAN); over udp else each module from its own address.",
            show_default="--no-relay over udp",
        ),
    ] = None
    fine: Annotated[bool, typer.Option("--fine", help="Send the fine (32-bit) samples.")] = False
    recording: Annotated[Path | None, typer.Option(help="Play a real recording instead of a motion.")] = None
    kind: Annotated[str, typer.Option("--format", help=f"Of the recording: {', '.join(READERS)}.")] = ""
    fresh: Annotated[int, typer.Option(min=0, help="So many modules come from the factory, all of id 0.")] = 0
    id_conflict: Annotated[
        bool, typer.Option("--id-conflict", help="The last module has the id of the one before it.")
    ] = False
    gnss: Annotated[
        Path | None, typer.Option(help="A satellite receiver on the body's root too: link to its port.")
    ] = None
    gnss_format: Annotated[str, typer.Option(help=f"What it speaks: {', '.join(FORMATS)}.")] = "nmea"
    faults: Annotated[
        Path | None,
        typer.Option(help="What goes wrong and when: a YAML file such as config/faults.yaml."),
    ] = None
    tumbling: Annotated[
        bool,
        typer.Option("--tumbling", help="The suit lies in a box that is turned: for `calibrate sensors`."),
    ] = False
    motion: Annotated[
        MotionKind,
        typer.Option(
            help="What the body does; calibration: the steps of `calibrate body`, over and over; everyday: a "
            "person walks, turns, reaches out and squats."
        ),
    ] = MotionKind.OWN
    strap_on: Annotated[
        StrapOn,
        typer.Option(help="random: modules turned anyhow on their segments, each 2 cm off its place."),
    ] = StrapOn.RIG
    upside_down: Annotated[
        list[int] | None,
        typer.Option(help="This module sits upside down on its segment; as often as needed."),
    ] = None
    swapped: Annotated[
        tuple[int, int] | None, typer.Option(help="These two modules have changed places.", metavar="ID ID")
    ] = None
    facing: Annotated[
        float,
        typer.Option(
            min=-360, max=360, help="Heading of the wearer who calibrates, degrees anticlockwise from east."
        ),
    ] = 0.0
    seed: Annotated[int, typer.Option(min=0, help="Of the motion and of everything random.")] = 1
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after so long.")] = None
    as_json: Annotated[bool, typer.Option("--json", help="Say where and since when as JSON.")] = False


def faulty(traffic: SuitTraffic, path: Path) -> FaultySuit:
    """Return a suit with the faults of a file. Raises ``GatewayError`` naming file and field."""
    try:
        return FaultySuit(traffic, load_settings(path, FaultPlan))
    except KeyError as error:
        raise GatewayError(f"{path}: {error.args[0]}") from error


def plan_of(source: object) -> FaultPlan:
    """Return what goes wrong with a source of transmissions; nothing unless it is a faulty suit."""
    return source.plan if isinstance(source, FaultySuit) else FaultPlan()


def fault_summary(source: object) -> str:
    """List the faults that a suit had, for the last line of the command."""
    if not isinstance(source, FaultySuit):
        return ""
    befell = ", ".join(f"{kind} {count}" for kind, count in sorted(source.counts.items()))
    return f"; faults: {befell or 'none'}"


Companion = Callable[[int], EmulatedSuit]
"""Of the instant at which the motion starts, ns of gateway time."""


def without_position_devices(suit: WornSuit) -> WornSuit:
    """Return the suit without the local devices whose part the satellite receiver plays."""
    kept = tuple(d for d in suit.local_devices if d.quantity not in {Quantity.POSITION, Quantity.VELOCITY})
    return replace(suit, local_devices=kept)


def companion(wanted: Emulation, link: Path) -> Companion:
    """Return the receiver, to be started with the suit. Raises ``GatewayError`` for an unknown format."""
    kind = wanted.gnss_format
    if kind not in FORMATS:
        raise GatewayError(f"--gnss-format {kind}: unknown{nearest(kind, FORMATS)}")
    path = _path(load_rig(wanted.rig), wanted.seed)
    emulation = GnssEmulation(kind=kind)

    def start(start_ns: int) -> EmulatedSuit:
        traffic: Iterable[Transmission] = gnss_traffic(path, start_ns, emulation, wanted.seed)
        if (end_s := wanted.seconds) is not None:
            traffic = takewhile(lambda sent: sent.time_s < end_s, traffic)
        return EmulatedSuit(traffic, PtyTransport(link), start_ns=start_ns)

    return start


def _path(suit: WornSuit, seed: int) -> Callable[[float], tuple[FloatArray, FloatArray]]:
    """Return the path of the root's device that measures position; of its joint if there is none."""
    motion = move_about(dress(without_position_devices(suit)), suit.skeleton.name, seed)
    positions = [d.position for d in suit.local_devices if d.segment == 0 and d.quantity is Quantity.POSITION]
    arm = positions[0] if positions else np.zeros(3)
    step = 1e-3

    def place(t: float) -> tuple[FloatArray, FloatArray]:
        state = motion.state(np.array([t - step, t, t + step]))
        places = state.joint_position[:, 0] + state.R_wb[:, 0] @ arm
        # The velocity is a central difference.
        return places[1], (places[2] - places[0]) / (2.0 * step)

    return place


_SOON_S = 0.2
"""So long after it was typed: samples until then have been computed already."""

_SHAKEN_S = 1.5

EXPLANATION = (
    "type shake NAME, tap NAME or press NAME (its button) and Enter; NAME: a segment, or a module by its "
    "number in the rig"
)


_ACTIONS: dict[str, tuple[str, Callable[[SuitTraffic, int | str, float], None]]] = {
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
        outcome, is_done = _do(line, suit, traffic) if line else (EXPLANATION, False)
        if not (is_quiet and is_done):
            typer.echo(outcome, err=not is_done)


def _do(line: str, suit: EmulatedSuit, traffic: SuitTraffic) -> tuple[str, bool]:
    """Return what to say, and whether something is done."""
    action, _, name = line.partition(" ")
    if action not in _ACTIONS:
        return f"'{action}' is unknown; {EXPLANATION}", False
    # A name is understood with blanks, too: "left forearm".
    which: int | str = int(name) if name.isdecimal() else "_".join(name.split())
    try:
        device = traffic.device(which)
    except KeyError:
        worn = map(str, traffic.motion.body.segment_names)
        return f"no module is on '{name.strip()}'{nearest(str(which), worn)}", False
    done, act = _ACTIONS[action]
    suit.do(lambda: act(traffic, which, suit.motion_time_s(gateway_time_ns()) + _SOON_S))
    return f"module {device.module_id} ({device.unique_id.hex()}) {done}", True


_START_DELAY_NS = 500_000_000


_MODES = {SamplingMode.FUSED: FUSED, SamplingMode.RAW: RAW, SamplingMode.TRIGGERED: TRIGGERED}

_REMEDIES = {
    Medium.PTY: "name another place with --link",
    Medium.SLCAN: "name another place with --link",
    Medium.TCP: "is the port taken? name another one with --port",
    Medium.UDP: "correct --host",
    Medium.CAN: "make a virtual bus with: ip link add dev vcan0 type vcan; ip link set vcan0 up; "
    "a kernel without CAN can use --on slcan",
}


@with_options(Emulation)
def emulate(wanted: Emulation) -> None:
    """Emulate a suit: a moving body, its sensors with their errors, the modules' protocol.

    A human walks in a circle, a pendulum swings, anything else moves its joints at random; --seed makes it
    repeatable. The suit obeys a host as real modules do; a recording only plays.
    """
    source = _played(wanted) if wanted.recording is not None else _worn(wanted)
    receiver = None if wanted.gnss is None else companion(wanted, wanted.gnss)
    # The motion begins a moment later, so that a reader can connect before the first sample.
    start_ns = gateway_time_ns() + _START_DELAY_NS
    if wanted.motion is MotionKind.CALIBRATION:
        # A calibration follows a timetable on which wearer and program agree without talking.
        start_ns = begin_of_script(start_ns)
    vendor = vendor_suit_of(touchable(source), wanted.speaks, wanted.rig)
    try:
        transport = _transport(wanted) if vendor is None else _transport_of_each(wanted, vendor)
        _play(source, transport, wanted, receiver, start_ns)
    except (OSError, can.CanError) as error:
        raise GatewayError(
            f"the emulated suit cannot speak on {wanted.on}: {getattr(error, 'strerror', None) or error}; "
            f"{_REMEDIES[wanted.on]}"
        ) from error


def _encoding(wanted: Emulation) -> Encoding:
    is_can = wanted.on in {Medium.CAN, Medium.SLCAN}
    return Encoding(Framing.CAN if is_can else Framing.BYTE_STREAM, wanted.fd)


def _played(wanted: Emulation) -> Iterable[Transmission]:
    """Return a real recording. Raises ``GatewayError`` where it cannot be read."""
    if wanted.faults is not None:
        raise GatewayError("--faults needs a suit that moves: a recording only plays")
    assert wanted.recording is not None
    return play(_read(wanted.recording, wanted.kind), _encoding(wanted))


def _worn(wanted: Emulation) -> Conversation:
    """Return a suit on a moving body, with its faults. Raises ``GatewayError``."""
    if wanted.speaks is not None and wanted.speaks not in VENDOR_EMULATORS:
        raise GatewayError(f"--speaks {wanted.speaks}: unknown{nearest(wanted.speaks, VENDOR_EMULATORS)}")
    if wanted.imperfections not in PRESETS:
        raise GatewayError(
            f"--imperfections {wanted.imperfections}: unknown{nearest(wanted.imperfections, PRESETS)}"
        )
    suit = load_rig(wanted.rig)
    if wanted.gnss is not None:
        suit = without_position_devices(suit)
    imperfections = PRESETS[wanted.imperfections]
    if wanted.speaks is not None and emulators_of(wanted.speaks, suit)(suit.module_ids[0]).sends_as_one:
        # one program says what all measured at one instant
        imperfections = replace(
            imperfections, clock_skew_ppm=0.0, has_random_clock_start=False, has_random_phase=False,
            has_random_heading=False,
        )  # fmt: skip
    traffic = SuitTraffic(_motion(wanted, suit), _suit_settings(wanted, suit), imperfections, wanted.seed)
    return traffic if wanted.faults is None else faulty(traffic, wanted.faults)


def _suit_settings(wanted: Emulation, suit: WornSuit) -> SuitSettings:
    encoding = _encoding(wanted)
    # A relay's batches are byte streams of our own protocol; CAN and other makers have none.
    can_relay = encoding.framing is Framing.BYTE_STREAM and wanted.speaks is None
    relays = wanted.on is not Medium.UDP
    ids = suit.module_ids
    emulator = None if wanted.speaks is None else emulators_of(wanted.speaks, suit)
    fuses = emulator is not None and emulator(ids[0]).is_fused
    return SuitSettings(
        sampling_rate_hz=wanted.rate,
        mode=FUSED if fuses else _MODES[wanted.mode],
        is_fine=wanted.fine,
        has_relay=can_relay and (relays if wanted.relay is None else wanted.relay),
        encoding=encoding,
        emulator=emulator,
        gravity=suit.gravity,
        magnetic_field=suit.magnetic_field,
        sunlight=sunlight(suit, gateway_time_ns()),
        fresh=frozenset(ids[: wanted.fresh]),
        stored_ids={ids[-1]: ids[-2]} if wanted.id_conflict and len(ids) > 1 else {},
    )


def _motion(wanted: Emulation, suit: WornSuit) -> BodyMotion:
    """Return what the wearer does. Raises ``GatewayError`` for modules that cannot be worn as asked."""
    body = dress(suit)
    if wanted.strap_on is StrapOn.RANDOM:
        body = strapped_on(body, wanted.seed)
    try:
        body = worn_wrong(body, wanted.upside_down or (), wanted.swapped or ())
    except ValueError as error:
        raise GatewayError(str(error)) from error
    if wanted.motion is MotionKind.CALIBRATION:
        return calibrate(body, suit.skeleton.name, wanted.seed, radians(wanted.facing))
    if wanted.motion is MotionKind.EVERYDAY:
        return perform(body, suit.skeleton.name, wanted.seed)
    return (tumble if wanted.tumbling else move_about)(body, suit.skeleton.name, wanted.seed)


def _read(path: Path, kind: str) -> RecordedTracks:
    if kind not in READERS:
        raise GatewayError(f"--format {kind or 'is missing'}: unknown{nearest(kind, READERS)}")
    try:
        return READERS[kind](path)
    except (OSError, ValueError, KeyError) as error:
        raise GatewayError(f"{path} cannot be read as {kind}: {error}") from error


def _transport(wanted: Emulation) -> Transport:
    if wanted.key_file is not None:
        return _signed_transport(wanted, wanted.key_file)
    match wanted.on:
        case Medium.TCP:
            return TcpTransport(wanted.port)
        case Medium.UDP:
            return UdpTransport(wanted.port, wanted.host)
        case Medium.CAN:
            return CanBusTransport(wanted.channel, "socketcan", fd=wanted.fd)
        case Medium.SLCAN:
            return SlcanTransport(wanted.link)
        case Medium.PTY:
            return PtyTransport(wanted.link)


def _transport_of_each(wanted: Emulation, vendor: VendorSuit) -> LinkPerDevice:
    """Return a link a module: ports one after the other, links to pseudo-terminals named for the modules."""
    _refuse_medium(wanted, vendor)
    # Streamers of whole bodies send all modules over one link.
    if all(emulator.sends_as_one for emulator in vendor.emulators.values()):
        return LinkPerDevice(dict.fromkeys(vendor.emulators, _transport(wanted)))
    single = len(vendor.emulators) == 1
    links: dict[int, Transport] = {}
    for place, (module, emulator) in enumerate(vendor.emulators.items()):
        link = wanted.link
        if link is not None and not single:
            link = link.with_name(f"{link.name}-{module}")
        # Devices that share a link have one port, and are told apart by what they send.
        beside = 0 if emulator.shares_link else place
        one = replace(wanted, port=wanted.port and wanted.port + beside, link=link)
        if wanted.on is Medium.UDP:
            links[module] = UdpTransport(one.port, one.host, emulator.from_port)
        else:
            links[module] = _transport(one)
    return LinkPerDevice(links)


def _refuse_medium(wanted: Emulation, vendor: VendorSuit) -> None:
    """Raise ``GatewayError`` where devices do not speak on what is asked for, or not several of them."""
    emulator = next(iter(vendor.emulators.values()))
    options = f"--speaks {wanted.speaks} --on {wanted.on}"
    is_bus = wanted.on in {Medium.CAN, Medium.SLCAN}
    if emulator.shares_link and wanted.on is not Medium.UDP:
        raise GatewayError(f"{options}: these speak over udp: --on udp")
    if emulator.framing is Framing.CAN and not is_bus:
        raise GatewayError(f"{options}: these speak on CAN: --on slcan, or --on can")
    if is_bus and emulator.framing is not Framing.CAN:
        raise GatewayError(f"{options}: these do not speak on CAN: --on pty, tcp or udp")
    if wanted.on is Medium.CAN and len(vendor.emulators) > 1 and not emulator.shares_bus:
        raise GatewayError(f"{options}: there can be one of these on a bus: --on slcan gives each its own")


def _signed_transport(wanted: Emulation, key_file: Path) -> Transport:
    if wanted.on not in {Medium.TCP, Medium.UDP}:
        raise GatewayError(f"--key-file: nothing is signed on {wanted.on}; take --on tcp or --on udp")
    try:
        if wanted.on is Medium.TCP:
            return SignedTcpTransport(key_file, wanted.port)
        return SignedUdpTransport(key_file, wanted.port, wanted.host)
    except ValueError as error:
        raise GatewayError(f"--key-file: {error}") from error


def _play(
    source: Conversation | Iterable[Transmission],
    transport: Transport,
    wanted: Emulation,
    receiver: Companion | None,
    start_ns: int,
) -> None:
    beside = None if receiver is None else receiver(start_ns)
    suit = EmulatedSuit(source, transport, start_ns=start_ns, duration_s=wanted.seconds)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_run(suit, beside, source, wanted))
    if not wanted.as_json:
        counts = suit.counts
        Console().print(
            f"sent {counts.sent_bytes} bytes; {counts.dropped_bytes} dropped because nobody read them"
            f"{fault_summary(source)}"
        )


async def _run(suit: EmulatedSuit, beside: EmulatedSuit | None, source: object, wanted: Emulation) -> None:
    as_json = wanted.as_json
    runs = [suit.run()] if beside is None else [suit.run(), beside.run()]
    task = asyncio.ensure_future(asyncio.gather(*runs))
    # Else the link to the port would stay, and one day lead to another.
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup has it
            asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    companions = [asyncio.create_task(pull_cable(plan_of(source), suit))]
    vendor = vendor_suit_of(touchable(source), wanted.speaks, wanted.rig)
    if vendor is not None and wanted.on is Medium.UDP:
        ports = range(wanted.port, wanted.port + len(vendor.emulators))
        announced = zip(vendor.emulators.values(), ports, strict=True)
        companions.append(asyncio.create_task(announce(announced, wanted.host)))
    while not (url := suit.transport.url) and not task.done():  # noqa: ASYNC110 - for a moment
        await asyncio.sleep(0.01)
    traffic = touchable(source)
    if url:
        if vendor is None:
            _announce(url, suit, as_json, traffic is not None)
        else:
            assert isinstance(suit.transport, LinkPerDevice)
            print_links(suit.transport.urls, suit, vendor, as_json)
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
    Console().print(f"emulated suit on [bold]{escape(url)}[/bold]  (Ctrl-C ends it)", soft_wrap=True)
    if is_touchable and sys.stdin is not None and sys.stdin.isatty():
        Console().print(EXPLANATION)
