"""The links of a set-up: ports and buses there, quick and wide enough, and which modules are heard there."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlsplit

from devices.commands.device_errors import DeviceError
from devices.endpoints import DEFAULT_BITRATE, CanRate, UartRate, line_rate, link_from_url
from devices.link import SUIT, LinkBusyError, LinkError
from devices.replay_link import is_recording
from firmware_protocol import Defect, InertialSample
from firmware_protocol.capacity import Traffic, can_load, uart_load
from gateway.body.skeleton import WornSuit
from gateway.doctor.findings import Finding, Surroundings, Verdict, bad, good, warning
from gateway.errors import GatewayError
from gateway.modules.journal import Journal, default_journal_path
from gateway.modules.makers import MakersModules
from gateway.modules.operations import ModuleOperations
from gateway.modules.session import suit_session
from gateway.modules.summary import ModuleList, ModuleSummary
from gateway.reconstruction import FUSED
from gateway.sources.link_settings import LinkSettings
from gateway.sources.makers import ANOTHER_SENDER, OthersLinkSettings, SettingAdvice

LONGEST_LATENCY_MS = 2
_UDEV_RULE = "docker/udev/60-mocap-gateway.rules"
_CHANGING_NAME = re.compile(r"^/dev/tty(USB|ACM)\d+$")
_SERIAL_SCHEMES = frozenset({"", "serial", "slcan"})


async def opening(link: LinkSettings, *, gateway_runs: bool) -> Finding:
    """Return whether the port can be opened; it is, for a moment. A running gateway may have it open."""
    subject = f"{link.name}: port"
    opened = link_from_url(link.url, name=link.name)
    try:
        await opened.open()
    except LinkError as error:
        found, _, remedy = str(error).partition("; ")
        if gateway_runs and isinstance(error, LinkBusyError):
            return good(subject, f"{link.url} is open in the running gateway")
        return bad(subject, found, remedy or "correct its url in the configuration, or plug it in")
    await opened.close()
    what = "recording can be read" if is_recording(opened) else "can be opened"
    return good(subject, f"{link.url} {what}")


def device_of(url: str) -> str | None:
    """Return the path of the device file in an endpoint; None for one that has none."""
    parts = urlsplit(url)
    if parts.scheme not in _SERIAL_SCHEMES or not parts.path.startswith("/dev/"):
        return None
    return parts.path


def naming(link: LinkSettings, surroundings: Surroundings) -> Iterator[Finding]:
    """Yield whether the port's name will be the same after the next plugging in."""
    device = device_of(link.url)
    if device is None:
        return
    subject = f"{link.name}: name"
    if not _CHANGING_NAME.match(device):
        if "/by-id/" in device or device.startswith("/dev/mocap/"):
            yield good(subject, f"{device} stays the same however it is plugged in")
        return
    names = sorted(surroundings.by_id.iterdir()) if surroundings.by_id.is_dir() else []
    stable = next((str(name) for name in names if _target(name) == device), None)
    remedy = f"write url: {stable}" if stable else f"install {_UDEV_RULE} and use /dev/mocap/<serial number>"
    yield warning(subject, f"{device} may be another adapter after the next plugging in", remedy)


def latency(link: LinkSettings, surroundings: Surroundings) -> Iterator[Finding]:
    """Yield how long the adapter keeps bytes back: FTDI's default is 16 ms."""
    device = device_of(link.url)
    if device is None:
        return
    tty = Path(os.path.realpath(device)).name
    timer = surroundings.sysfs / "class" / "tty" / tty / "device" / "latency_timer"
    try:
        milliseconds = int(timer.read_text())
    except (OSError, ValueError):
        return  # not an adapter that has one
    subject = f"{link.name}: latency"
    if milliseconds <= LONGEST_LATENCY_MS:
        yield good(subject, f"latency_timer of {tty} is {milliseconds} ms")
        return
    yield warning(
        subject,
        f"latency_timer of {tty} is {milliseconds} ms: samples come in clumps, so much later",
        f"echo 1 | sudo tee {timer}; for good: install {_UDEV_RULE}",
    )


def _target(name: Path) -> str:
    """Return where a name under by-id leads, as far as it is one link to a device file."""
    try:
        return os.path.normpath(name.parent / name.readlink())
    except OSError:
        return ""


_WIRING = "check bit rate, the two 120 Ω terminators, and that CAN high and low are not exchanged"
_WORRYING = frozenset({"ERROR-WARNING", "ERROR-PASSIVE"})


def can_interface(link: LinkSettings, surroundings: Surroundings) -> Iterator[Finding]:
    """Yield what the kernel says of the interface that a ``can://socketcan/…`` link names."""
    parts = urlsplit(link.url)
    if parts.scheme != "can" or parts.netloc != "socketcan":
        return
    interface = parts.path.strip("/")
    subject = f"{link.name}: CAN"
    if not (surroundings.sysfs / "class" / "net" / interface).exists():
        yield bad(subject, f"there is no interface {interface}", "plug the CAN adapter in, or correct url")
        return
    rate = line_rate(link.url)
    assert isinstance(rate, CanRate)
    up = _up_command(interface, rate)
    # Bit 0 of the flags is IFF_UP (linux/if.h).
    if _read(surroundings, interface, "flags", base=16) & 1 == 0:
        yield bad(subject, f"{interface} is down", up)
        return
    details = _details(surroundings.describe_interface(interface))
    if details:
        has_rate = "bitrate" in dict(parse_qsl(parts.query))
        troubles = list(_troubles(subject, interface, details, rate, has_rate, up))
        yield from troubles or [good(subject, f"{interface} is up{_speed(details)}")]
    else:
        yield good(subject, f"{interface} is up")


def _troubles(
    subject: str, interface: str, details: dict[str, Any], rate: CanRate, has_rate: bool, up: str
) -> Iterator[Finding]:
    state = details.get("state")
    again = f"sudo ip link set {interface} down; {up}"
    if state == "BUS-OFF":
        yield bad(subject, f"{interface} is bus-off: too many errors", f"{_WIRING}; then: {again}")
    elif state in _WORRYING:
        yield warning(subject, f"{interface} is {str(state).lower()}: many errors", _WIRING)
    actual = details.get("bittiming", {}).get("bitrate")
    if has_rate and actual is not None and actual != rate.bitrate:
        found = f"{interface} runs at {actual:,} bit/s, the configuration says {rate.bitrate:,}"
        yield bad(subject, found, f"{again}; or correct bitrate in url")
    data = details.get("data_bittiming", {}).get("bitrate")
    if rate.data_bitrate is not None and data is None and "bittiming" in details:
        yield bad(subject, f"{interface} is up without CAN FD, the configuration says fd=1", again)


def _speed(details: dict[str, Any]) -> str:
    bitrate = details.get("bittiming", {}).get("bitrate")
    return f" at {bitrate:,} bit/s" if bitrate else ""


def _up_command(interface: str, rate: CanRate) -> str:
    data = f" dbitrate {rate.data_bitrate} fd on" if rate.data_bitrate else ""
    bitrate = rate.bitrate or DEFAULT_BITRATE
    return f"sudo ip link set {interface} up type can bitrate {bitrate}{data} restart-ms 100"


def _read(surroundings: Surroundings, interface: str, attribute: str, base: int) -> int:
    try:
        return int((surroundings.sysfs / "class" / "net" / interface / attribute).read_text(), base)
    except (OSError, ValueError):
        return 0


# Only a rate that the url names can be compared with the interface's own.


def _details(described: str | None) -> dict[str, Any]:
    """Return the part about CAN of what ``ip -details -json`` says; empty for an interface that has none."""
    try:
        (interface,) = json.loads(described or "[]")
        found = interface["linkinfo"]["info_data"]
    except (ValueError, KeyError, TypeError):
        return {}
    return found if isinstance(found, dict) else {}


COMFORTABLE = 0.7
"""Share of a line above which bursts, retries and commands begin to wait."""
_FULL_SAMPLE = InertialSample((0.0, 0.0, 9.8), (20.0, 0.0, -40.0), (0.0, 0.0, 0.0))


def capacity(name: str, url: str, n_modules: int, rate_hz: float) -> Iterator[Finding]:
    """Yield whether the link's line carries so many modules (accelerometer, magnetometer and gyroscope
    each)."""
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
        yield good(f"{name}: capacity", found)
        return
    # Beyond the full line samples are lost for certain; just below it bursts are late.
    verdict = Verdict.BAD if load > 1 else Verdict.WARNING
    yield Finding(
        f"{name}: capacity", verdict, found, f"{remedy}, or at most {rate_hz * COMFORTABLE / load:.0f} Hz"
    )


def _uart_remedy(traffic: list[Traffic], rate: UartRate) -> str:
    with_relay = uart_load(traffic, rate.baud, has_relay=True)
    needed = uart_load(traffic, 1) / COMFORTABLE
    return f"at least {needed:,.0f} baud, a relay that batches ({with_relay:.0%})"


MOST_DAMAGED = 0.02
"""Share of wire frames with errors, above which a line is bad."""
GARBAGE = 0.5
"""Above this it is not noise: the other end speaks at another rate, or something else."""
MOST_LOST_PERCENT = 1.0
SHORTEST_S = 0.5
_LEAST_FRAMES = 5
_GARBLED = (Defect.OVERLONG, Defect.BAD_STUFFING, Defect.TOO_SHORT, Defect.BAD_CRC, Defect.BAD_VERSION)


async def listen(
    links: Sequence[LinkSettings], suit: WornSuit, seconds: float, rate_hz: float, method: str
) -> list[Finding]:
    """Read the links, and ask modules who they are; changes nothing in them. rate_hz: of the poses, which
    the method makes."""
    journal = Journal(default_journal_path())
    try:
        # Without writes: a diagnosis changes nothing.
        async with suit_session(links, suit, allow_writes=False, journal=journal) as operations:
            listed = await operations.perform("list", {"listen_s": max(seconds, SHORTEST_S)})
            found = ModuleList.model_validate(
                {k: v for k, v in listed.items() if k in ModuleList.model_fields}
            )
            others = [link for link in links if link.carries != SUIT]
            own = [link for link in links if link.carries == SUIT]
            return [
                *_readability(own, operations),
                *_others_readability(others, operations.makers),
                *_usable(others, operations.makers, method),
                *_others_settings(await operations.makers.advice(rate_hz)),
                *_presence(_without_unworn(found, others, operations.makers), suit, OWN if own else OTHERS),
            ]
    # Messages of this kind have the remedy after the first semicolon.
    except (GatewayError, LinkError, DeviceError) as error:
        what, _, remedy = str(error).partition("; ")
        return [bad("suit", what, remedy or "see the findings about its ports")]


def _readability(links: Sequence[LinkSettings], operations: ModuleOperations) -> Iterator[Finding]:
    stream = operations.stream
    received = sum(record.received for record in stream.modules.values())
    dropped_by_link = stream.dropped()
    for name, url in ((link.name, link.url) for link in links):
        dropped = dropped_by_link.get(name, {})
        garbled = sum(dropped.get(defect.name.lower(), 0) for defect in _GARBLED)
        yield from _line(f"{name}: data", url, garbled, received)
        yield from _signatures(f"{name}: signatures", operations.unverified(name))


def _others_readability(links: Sequence[LinkSettings], makers: MakersModules) -> Iterator[Finding]:
    """Yield findings on the data of other makers' modules."""
    for link in links:
        received = makers.received(link.name)
        unread = {reason: count for reason, count in received.dropped.items() if reason != ANOTHER_SENDER}
        yield from _line(
            f"{link.name}: data", link.url, sum(unread.values()), received.received, link.carries
        )
        if strangers := received.dropped.get(ANOTHER_SENDER):
            found = f"{strangers:,} datagrams came from a second device"
            yield bad(f"{link.name}: senders", found, "let every device send to a port and a link of its own")


def _usable(links: Sequence[LinkSettings], makers: MakersModules, method: str) -> Iterator[Finding]:
    """Yield whether what other makers' modules send is what the method takes."""
    for link in links:
        received, subject = makers.received(link.name), f"{link.name}: method"
        if received.orientations and not received.samples and method not in FUSED:
            yield bad(
                subject,
                f"it sends orientations fused on board, and no raw samples: '{method}' makes nothing of them",
                "write reconstructor: fused_neutral (or fused, where all references face alike)",
            )
        elif received.samples and not received.orientations and method in FUSED:
            yield bad(
                subject,
                f"it sends raw samples, and no orientations: '{method}' makes nothing of them",
                "write reconstructor: joint",
            )
        elif received.samples or received.orientations:
            yield good(subject, f"'{method}' takes what it sends")


def _others_settings(advice: Sequence[tuple[str, SettingAdvice]]) -> Iterator[Finding]:
    for link, each in advice:
        yield warning(f"{link}: settings", each.found, each.remedy)


_WIRE_REMEDY = "a shorter or shielded cable, common ground, a lower baud rate"
_NETWORK_REMEDY = "bridge/health counts why, by link; let nobody else send to this port: peers=ADDRESS in url"
_WORSE_LINES = {"udp": _NETWORK_REMEDY, "tcp": _WIRE_REMEDY + " before the serial server"}


def _line(subject: str, url: str, garbled: int, received: int, carries: str = SUIT) -> Iterator[Finding]:
    total = garbled + received
    is_suit = carries == SUIT
    kind = "" if is_suit else f", or carries: nothing says that it is a device of '{carries}'"
    if total < _LEAST_FRAMES:
        what = "the suit" if is_suit else "it"
        remedy = f"switch {what} on; check the wiring (RX and TX exchanged?) and that this is its port{kind}"
        yield bad(subject, f"nothing readable comes ({total} wire frames)", remedy)
        return
    share = garbled / total
    found = f"{garbled:,} of {total:,} wire frames are damaged ({share:.0%})"
    rate = line_rate(url)
    # Garbage on a serial line is nearly always the rate: bits are cut at the wrong places.
    if share > GARBAGE and (isinstance(rate, UartRate) or url.startswith("/dev/")):
        baud = f" (it is read at {rate.baud:,})" if isinstance(rate, UartRate) else ""
        yield bad(subject, f"{found}: the baud rate is wrong{baud}", f"write its own: url: …?baud=…{kind}")
    elif share > GARBAGE:
        yield bad(subject, f"{found}: something else is at the other end", f"correct url{kind}")
    elif share > MOST_DAMAGED:
        yield warning(subject, found, _WORSE_LINES.get(urlsplit(url).scheme, _WIRE_REMEDY))
    else:
        yield good(subject, found)


def _signatures(subject: str, unverified: Mapping[Defect, int]) -> Iterator[Finding]:
    """Yield findings on a signed link."""
    for defect, count in unverified.items():
        # A module without a count yet gets it from the gateway: that is the normal start, and nothing to
        # find.
        if defect is not Defect.OUTDATED:
            remedy = "give every module that may send there the key of the link; find out who else sends"
            yield warning(subject, f"{count:,} wire frames dropped ({defect.name}): {defect.value}", remedy)


def _without_unworn(found: ModuleList, links: Sequence[LinkSettings], makers: MakersModules) -> ModuleList:
    """Leave out what a stream of a whole body has and the rig does not wear: that is nothing to find."""
    whole = [link for link in links if isinstance(link, OthersLinkSettings) and not link.own_numbers]
    parts = {module for link in whole for module in makers.modules_of(link.name)}
    modules = tuple(each for each in found.modules if each.segment is not None or each.module not in parts)
    return found.model_copy(update={"modules": modules})


class Numbering(NamedTuple):
    """What gives modules their numbers, for those that have none of the rig."""

    silent: str
    stranger: str


OWN = Numbering(
    "or give them these ids: mocap-gateway modules assign",
    "correct the rig, or give them its ids: mocap-gateway modules assign",
)
OTHERS = Numbering(
    "see the findings about their links, and correct 'module' there where another number is meant",
    "correct 'module' at their links, or the rig",
)


def _presence(found: ModuleList, suit: WornSuit, numbering: Numbering) -> Iterator[Finding]:
    reporting = {module.module: module for module in found.modules}
    if not reporting:
        return
    segments = {module: segment for segment, module in found.segments.items()}
    silent = [f"{module} ({segments[module]})" for module in suit.module_ids if module not in reporting]
    if silent:
        remedy = f"switch them on, check battery and plug; {numbering.silent}"
        yield bad("modules: heard", f"never heard: {', '.join(silent)}", remedy)
    else:
        yield good("modules: heard", f"all {len(suit.module_ids)} modules of the rig are heard")
    for conflict in found.conflicts:
        who = ", ".join(conflict.unique_ids)
        yield bad(
            "modules: ids",
            f"module id {conflict.module} is shared by {len(conflict.unique_ids)} devices: {who}",
            "mocap-gateway modules assign --allow-writes gives each its own",
        )
    strangers = [m for m in found.modules if m.segment is None and m.rate_hz]
    if strangers:
        ids = ", ".join(str(module.module) for module in strangers)
        yield warning("modules: rig", f"send, but the rig does not name them: {ids}", numbering.stranger)
    yield from _losses(found.modules)


def _losses(modules: Sequence[ModuleSummary]) -> Iterator[Finding]:
    losing = [m for m in modules if m.loss_percent is not None and m.loss_percent > MOST_LOST_PERCENT]
    if losing:
        each = ", ".join(f"{module.module}: {module.loss_percent:.1f} %" for module in losing)
        remedy = "see capacity and data above; a lower sampling rate, shorter cables, a nearer receiver"
        yield warning("modules: loss", f"packets are lost of module {each}", remedy)
