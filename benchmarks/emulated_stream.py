"""Wire bytes of emulated suits, made beforehand so that making them is not measured."""

from __future__ import annotations

from devices.emulators.imperfections import IDEAL, Imperfections
from devices.emulators.motions import BodyMotion
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.cli.emulated_rig import dress, move

LINK = "suit"


def suit_17() -> tuple[WornSuit, BodyMotion]:
    """The shipped 17-module suit and a walking person in it."""
    suit = load_rig("suit_17")
    return suit, move(dress(suit), suit.skeleton.name, seed=1)


def relay_chunks(
    motion: BodyMotion,
    seconds: float,
    rate_hz: float = 100.0,
    has_relay: bool = True,
    imperfections: Imperfections = IDEAL,
) -> list[Chunk]:
    """What the suit sends in so many seconds, one chunk a transmission, arrival times as emulated."""
    settings = SuitSettings(sampling_rate_hz=rate_hz, has_relay=has_relay)
    traffic = SuitTraffic(motion, settings, imperfections, seed=1)
    return [Chunk(sent.data, round(sent.time_s * 1e9), LINK) for sent in traffic.transmissions(seconds)]
