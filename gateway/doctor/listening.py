"""Listen to the suit for a moment: is it readable, who is there, who is not, who shares an id."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from devices.device_errors import DeviceError
from devices.line_rate import UartRate, line_rate
from devices.link import LinkError
from firmware_protocol import Defect
from gateway.body.skeleton import WornSuit
from gateway.doctor.findings import Finding, bad, good, warning
from gateway.errors import GatewayError
from gateway.modules.journal import Journal, default_journal_path
from gateway.modules.operations import ModuleOperations
from gateway.modules.session import suit_session
from gateway.modules.summary import ModuleList, ModuleSummary
from gateway.sources.link_settings import LinkSettings

MOST_DAMAGED = 0.02
"""Share of wire frames with errors, above which a line is bad."""
GARBAGE = 0.5
"""Above this it is not noise: the other end speaks at another rate, or something else."""
MOST_LOST_PERCENT = 1.0
SHORTEST_S = 0.5
_LEAST_FRAMES = 5
_GARBLED = (Defect.OVERLONG, Defect.BAD_STUFFING, Defect.TOO_SHORT, Defect.BAD_CRC, Defect.BAD_VERSION)


async def listen(links: Sequence[LinkSettings], suit: WornSuit, seconds: float) -> list[Finding]:
    """Read the links, and ask modules who they are; changes nothing in them."""
    urls = {link.name: link.url for link in links}
    journal = Journal(default_journal_path())
    try:
        async with suit_session(urls, suit, allow_writes=False, journal=journal) as operations:
            listed = await operations.perform("list", {"listen_s": max(seconds, SHORTEST_S)})
            found = ModuleList.model_validate({k: v for k, v in listed.items() if k != "allows_writes"})
            return [*_readability(urls, operations), *_presence(found, suit)]
    except (GatewayError, LinkError, DeviceError) as error:
        what, _, remedy = str(error).partition("; ")
        return [bad("suit", what, remedy or "see the findings about its ports")]


def _readability(urls: Mapping[str, str], operations: ModuleOperations) -> Iterator[Finding]:
    stream = operations.stream
    received = sum(record.received for record in stream.modules.values())
    dropped_by_link = stream.dropped()
    for name, url in urls.items():
        dropped = dropped_by_link.get(name, {})
        garbled = sum(dropped.get(defect.name.lower(), 0) for defect in _GARBLED)
        yield from _line(f"{name}: data", url, garbled, received)
        yield from _signatures(f"{name}: signatures", operations.unverified(name))


def _line(subject: str, url: str, garbled: int, received: int) -> Iterator[Finding]:
    total = garbled + received
    if total < _LEAST_FRAMES:
        remedy = "switch the suit on; check the wiring (RX and TX exchanged?) and that this is its port"
        yield bad(subject, f"nothing readable comes ({total} wire frames)", remedy)
        return
    share = garbled / total
    found = f"{garbled:,} of {total:,} wire frames are damaged ({share:.0%})"
    rate = line_rate(url)
    if share > GARBAGE and (isinstance(rate, UartRate) or url.startswith("/dev/")):
        baud = f" (it is read at {rate.baud:,})" if isinstance(rate, UartRate) else ""
        yield bad(subject, f"{found}: the baud rate is wrong{baud}", "write the suit's own: url: …?baud=…")
    elif share > GARBAGE:
        yield bad(subject, f"{found}: something else is at the other end", "correct url")
    elif share > MOST_DAMAGED:
        remedy = "a shorter or shielded cable, common ground, a lower baud rate"
        yield warning(subject, found, remedy)
    else:
        yield good(subject, found)


def _signatures(subject: str, unverified: Mapping[Defect, int]) -> Iterator[Finding]:
    """Of a signed link. Modules that have no count yet are told it: that is nothing to find."""
    for defect, count in unverified.items():
        if defect is not Defect.OUTDATED:
            remedy = "give every module that may send there the key of the link; find out who else sends"
            yield warning(subject, f"{count:,} wire frames dropped ({defect.name}): {defect.value}", remedy)


def _presence(found: ModuleList, suit: WornSuit) -> Iterator[Finding]:
    heard = {module.module: module for module in found.modules}
    if not heard:
        return
    segments = {module: segment for segment, module in found.segments.items()}
    silent = [f"{module} ({segments[module]})" for module in suit.module_ids if module not in heard]
    if silent:
        remedy = (
            "switch them on, check battery and plug; or give them these ids: mocap-gateway modules assign"
        )
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
        remedy = "correct the rig, or give them its ids: mocap-gateway modules assign"
        yield warning("modules: rig", f"send, but the rig does not name them: {ids}", remedy)
    yield from _losses(found.modules)


def _losses(modules: Sequence[ModuleSummary]) -> Iterator[Finding]:
    losing = [m for m in modules if m.loss_percent is not None and m.loss_percent > MOST_LOST_PERCENT]
    if losing:
        each = ", ".join(f"{module.module}: {module.loss_percent:.1f} %" for module in losing)
        remedy = "see capacity and data above; a lower sampling rate, shorter cables, a nearer receiver"
        yield warning("modules: loss", f"packets are lost of module {each}", remedy)
