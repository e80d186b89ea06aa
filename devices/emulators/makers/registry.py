"""The emulators by the word that the configuration has for what their links carry. A maker is a line here.

An emulator is imported when a module first speaks with it.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence

from devices.deferred import Deferred
from devices.emulators.makers.vendor_emulator import VendorEmulator

_ANNOUNCED_EVERY_S = 1.0


_Emulators = Mapping[int, VendorEmulator]


def _each(module: str, emulator: str) -> Callable[[Sequence[int], float], _Emulators]:
    """Return what makes emulators of devices that know nothing of each other."""
    make: Callable[[int, float], VendorEmulator] = Deferred(f"{__package__}.{module}", emulator)
    return lambda modules, field_ut: {each: make(each, field_ut) for each in modules}


def _together(module: str, emulators: str) -> Callable[[Sequence[int], float], _Emulators]:
    """Return what makes emulators of devices that share a link, an instant or numbers."""
    return Deferred(f"{__package__}.{module}", emulators)


VENDOR_EMULATORS: Mapping[str, Callable[[Sequence[int], float], Mapping[int, VendorEmulator]]] = {
    "ximu3": _together("ximu3", "ximu3_emulators"),
    "mti": _each("mti", "MtiEmulator"),
    "mti_can": _each("mti", "MtiCanEmulator"),
    "witmotion": _each("witmotion", "WitMotionEmulator"),
    "witmotion_can": _together("witmotion", "witmotion_can_emulators"),
    "slimevr": _each("slimevr", "SlimevrEmulator"),
    "mvn": _together("mvn", "mvn_emulators"),
    "bno08x_rvc": _each("bno08x", "Bno08xEmulator"),
    "mocopi": _together("mocopi", "mocopi_emulators"),
}
"""By what a link carries: makes emulators from the numbers of devices and the strength of the field, µT."""


async def announce(emulators: Iterable[tuple[VendorEmulator, int]], host: str) -> None:
    """Have devices announce themselves to a host, again and again. emulators: each with the port that it
    sends to; those that never announce themselves are silent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        sending.setblocking(False)
        devices = list(emulators)
        while True:
            for emulator, port in devices:
                announced = emulator.announcement(port)
                if announced is not None:
                    sending.sendto(announced[1], (host, announced[0]))
            await asyncio.sleep(_ANNOUNCED_EVERY_S)
