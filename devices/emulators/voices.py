"""The voices by the word that the configuration has for what their links carry. A maker is a line here.

A voice is imported when a module first speaks with it.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence

from devices.deferred import Deferred
from devices.emulators.voice import Voice

_ANNOUNCED_EVERY_S = 1.0


_Voices = Mapping[int, Voice]


def _each(module: str, voice: str) -> Callable[[Sequence[int], float], _Voices]:
    """Return what makes voices of devices that know nothing of each other."""
    make: Callable[[int, float], Voice] = Deferred(f"devices.emulators.{module}", voice)
    return lambda modules, field_ut: {each: make(each, field_ut) for each in modules}


def _together(module: str, voices: str) -> Callable[[Sequence[int], float], _Voices]:
    """Return what makes voices of devices that share a link, an instant or numbers."""
    return Deferred(f"devices.emulators.{module}", voices)


VOICES: Mapping[str, Callable[[Sequence[int], float], Mapping[int, Voice]]] = {
    "ximu3": _together("ximu3_voice", "ximu3_voices"),
    "mti": _each("mti_voice", "MtiVoice"),
    "mti_can": _each("mti_voice", "MtiCanVoice"),
    "witmotion": _each("witmotion_voice", "WitMotionVoice"),
    "witmotion_can": _together("witmotion_voice", "witmotion_can_voices"),
    "slimevr": _each("slimevr_voice", "SlimevrVoice"),
    "mvn": _together("mvn_voice", "mvn_voices"),
    "bno08x_rvc": _each("bno08x_voice", "Bno08xVoice"),
    "mocopi": _together("mocopi_voice", "mocopi_voices"),
}
"""By what a link carries: makes voices from the numbers of devices and the strength of the field, µT."""


async def announce(voices: Iterable[tuple[Voice, int]], host: str) -> None:
    """Have devices announce themselves to a host, again and again. voices: each with the port that it sends
    to; those that never announce themselves are silent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        sending.setblocking(False)
        told = list(voices)
        while True:
            for voice, port in told:
                announced = voice.announcement(port)
                if announced is not None:
                    sending.sendto(announced[1], (host, announced[0]))
            await asyncio.sleep(_ANNOUNCED_EVERY_S)
