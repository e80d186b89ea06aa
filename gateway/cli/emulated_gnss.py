"""An emulated satellite receiver beside an emulated suit: it sits on the root of the same moving body."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import numpy as np

from devices.emulators.bodies import FloatArray
from devices.emulators.delivery import Transmission
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.gnss_receiver import FORMATS, GnssEmulation, gnss_traffic
from devices.emulators.transports import PtyTransport
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.emulation.rig import dress, move_about
from gateway.errors import GatewayError, nearest
from gateway.frames import Quantity

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
