"""What whoever types at ``mocap-gateway emulate`` does to the modules: shake them, tap them, press them."""

from __future__ import annotations

import signal
from collections.abc import Callable

import typer

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.faulty_suit import FaultySuit
from devices.emulators.suit_traffic import SuitTraffic
from devices.link import gateway_time_ns
from gateway.cli.typed_lines import TypedLines
from gateway.errors import nearest

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
