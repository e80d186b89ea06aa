"""Damaged traffic of other makers' protocols through their decoders: nothing may raise, and it is measured
how much that was damaged is taken for good.

::

    python -m devices.emulators.faults.makers_campaign --damaged 1000000 --seed 1 ximu3 mti

These protocols check little or nothing: a sum of 8 bits lets one damaged message in 256 through, the x-IMU3
has none. So a corrupt message that is accepted is no failure here, but a figure, for each way of damage.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any, NamedTuple, Protocol

from devices.emulators.faults.wire_damage import BYTE_DAMAGES, PIECE_DAMAGES
from devices.vendor_protocols import bno08x, mocopi, mti, mvn, slimevr, witmotion, ximu3
from firmware_protocol import pack_can_records, unpack_can_records

BLOCK = 256
"""Messages between two looks at what came out."""
_DAMAGED_SHARE = 0.5
_SHOWN_FAILURES = 5
_RECOVERED = 4
"""So many intact messages in a row, and the last of them must come through."""
_WAYS = (
    "bits",
    "cut short",
    "begins late",
    "spliced",
    "repeated",
    "overtaken",
    "bytes between",
    "noise before",
)
"""What ``BYTE_DAMAGES`` do, in their order."""
_CAN_WAYS = (
    "frame lost",
    "frame repeated",
    "frames reordered",
    "bits of data",
    "bit of identifier",
    "spliced",
    "foreign between",
)
"""What ``PIECE_DAMAGES`` do, in their order."""


class _Decoder(Protocol):
    dropped: Counter[str]

    def feed(self, data: bytes) -> Sequence[Any]:
        """Return the messages that the bytes complete."""


class Language(NamedTuple):
    """A protocol as a campaign sees it."""

    decoder: Callable[[], _Decoder]
    message: Callable[[Random, int], bytes]
    """A message of a number: no two of a campaign are alike."""
    is_datagram: bool = False
    """Whether it comes whole, as it was sent or damaged, and never in pieces."""
    is_can: bool = False
    """Whether it is records of CAN frames: whole ones come, of which some are lost or wrong."""


def _of_ximu3(rng: Random, number: int) -> bytes:
    time_us = 10**9 + 2500 * number
    if number % 20 == 7:
        return ximu3.encode_binary(b"M", time_us, [rng.uniform(-1, 1) for _ in range(3)])
    values = [rng.gauss(0, 200) for _ in range(3)] + [rng.gauss(0, 1.5) for _ in range(3)]
    return ximu3.encode_binary(b"I", time_us, values)


def _of_ximu3_text(rng: Random, number: int) -> bytes:
    values = [rng.gauss(0, 200) for _ in range(3)] + [rng.gauss(0, 1.5) for _ in range(3)]
    return ximu3.encode_text(b"I", 10**9 + 2500 * number, values)


def _of_mti(rng: Random, number: int) -> bytes:
    values: dict[str, Sequence[float]] = {
        "packet_counter": [number % 2**16],
        "sample_time_fine": [100 * number % 2**32],
        "status_word": [3],
        "acceleration": [rng.gauss(0, 10) for _ in range(3)],
        "rate_of_turn": [rng.gauss(0, 3) for _ in range(3)],
    }
    if number % 2:
        values["magnetic_field"] = [rng.uniform(-1, 1) for _ in range(3)]
    items = (mti.encode_item(name, each, number // BLOCK % 4) for name, each in values.items())
    return mti.encode(mti.Mid.MT_DATA_2, b"".join(items))


def _of_slimevr(rng: Random, number: int) -> bytes:
    turned = [rng.gauss(0, 1) for _ in range(4)]
    norm = sum(part * part for part in turned) ** 0.5
    w, x, y, z = (part / norm for part in turned)
    linear = rng.gauss(0, 5), rng.gauss(0, 5), rng.gauss(0, 5)
    if number % 3 == 0:
        both = slimevr.rotation_and_acceleration(number % 2, (w, x, y, z), linear)
        return slimevr.encode(slimevr.Kind.ROTATION_AND_ACCELERATION, 1 + number, both)
    turn = slimevr.Kind.ROTATION_DATA, slimevr.rotation_data(0, (w, x, y, z))
    if number % 3 == 1:
        return slimevr.encode(turn[0], 1 + number, turn[1])
    return slimevr.encode_bundle(
        1 + number, [turn, (slimevr.Kind.ACCELERATION, slimevr.acceleration(0, linear))]
    )


def _of_mti_can(rng: Random, number: int) -> bytes:
    values: dict[str, Sequence[float]] = {
        "sample_time_us": [10_000 * number % 2**32],
        "packet_counter": [number % 2**16],
        "acceleration": [rng.gauss(0, 10) for _ in range(3)],
        "rate_of_turn": [rng.gauss(0, 3) for _ in range(3)],
        "magnetic_field": [rng.uniform(-1, 1) for _ in range(3)],
    }
    return mti.encode_can(values)


def _witmotion_numbers(rng: Random) -> list[tuple[int, list[int]]]:
    numbers = [[rng.randrange(-(2**15), 2**15) for _ in range(3)] for _ in range(3)]
    kinds = witmotion.ACCELERATION, witmotion.ANGULAR_RATE, witmotion.FIELD
    return [(kind, [*each, 2500]) for kind, each in zip(kinds, numbers, strict=True)]


def _of_witmotion(rng: Random, number: int) -> bytes:
    return b"".join(witmotion.encode(kind, each) for kind, each in _witmotion_numbers(rng))


def _of_witmotion_can(rng: Random, number: int) -> bytes:
    return b"".join(witmotion.encode_can(kind, each) for kind, each in _witmotion_numbers(rng))


def _turned(rng: Random) -> tuple[float, float, float, float]:
    q = [rng.gauss(0, 1) for _ in range(4)]
    norm = sum(part * part for part in q) ** 0.5
    return q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm


def _vector(rng: Random, spread: float) -> tuple[float, float, float]:
    return rng.gauss(0, spread), rng.gauss(0, spread), rng.gauss(0, spread)


def _of_mvn(rng: Random, number: int) -> bytes:
    segments = range(1, 4)
    if number % 2:
        poses = [mvn.SegmentPose(each, _vector(rng, 1.0), _turned(rng)) for each in segments]
        return mvn.encode(mvn.QUATERNIONS, number, 10 * number, poses)
    trackers = [
        mvn.Tracker(each, _turned(rng), *(_vector(rng, spread) for spread in (1.0, 10.0, 3.0, 0.6)))
        for each in segments
    ]
    return mvn.encode(mvn.TRACKERS, number, 10 * number, trackers)


def _of_bno08x(rng: Random, number: int) -> bytes:
    angles = rng.uniform(-180, 180), rng.uniform(-90, 90), rng.uniform(-180, 180)
    return bno08x.encode(bno08x.Report(number, angles, _vector(rng, 1.0)))


def _of_mocopi(rng: Random, number: int) -> bytes:
    bones = tuple((bone, _turned(rng), _vector(rng, 0.3)) for bone in range(3))
    return mocopi.encode(mocopi.Frame(number, 20 * number, bones))


LANGUAGES: Mapping[str, Language] = {
    "ximu3": Language(ximu3.Ximu3Decoder, _of_ximu3),
    "ximu3_text": Language(ximu3.Ximu3Decoder, _of_ximu3_text),
    "mti": Language(mti.MtiDecoder, _of_mti),
    "mti_can": Language(mti.MtiCanDecoder, _of_mti_can, is_can=True),
    "witmotion": Language(witmotion.WitMotionDecoder, _of_witmotion),
    "witmotion_can": Language(witmotion.WitMotionCanDecoder, _of_witmotion_can, is_can=True),
    "mvn": Language(mvn.MvnDecoder, _of_mvn),
    "bno08x_rvc": Language(bno08x.Bno08xDecoder, _of_bno08x),
    "mocopi": Language(mocopi.MocopiDecoder, _of_mocopi, is_datagram=True),
    "slimevr": Language(slimevr.SlimevrDecoder, _of_slimevr, is_datagram=True),
}
"""By name. A maker is a line here, and how a message of it is made."""


@dataclass
class MakersFindings:
    """What a campaign found."""

    n_messages: int = 0
    n_accepted: int = 0
    damaged: Counter[str] = field(default_factory=Counter)
    """Messages, by way of damage."""
    corrupt: Counter[str] = field(default_factory=Counter)
    """Of these, how many were taken for another message than any that was sent."""
    raised: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    """Intact, after ``_RECOVERED`` others, and not accepted, however late."""
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def corrupt_share(self) -> float:
        """Of the damaged messages, how many were accepted as something else."""
        return self.corrupt.total() / max(self.damaged.total(), 1)

    def lines(self) -> Iterator[str]:
        """Yield the verdict."""
        yield (
            f"{self.n_messages} messages ({self.damaged.total()} damaged), {self.n_accepted} accepted; "
            f"{len(self.raised)} exceptions, {len(self.lost)} intact lost; "
            f"{100 * self.corrupt_share:.2f} % of the damaged accepted as something else"
        )
        for way in sorted(self.damaged, key=(_WAYS + _CAN_WAYS).index):
            share = self.corrupt[way] / max(self.damaged[way], 1)
            yield f"  {way:14} {self.damaged[way]:>8} damaged, {100 * share:6.2f} % so accepted"
        yield "  dropped: " + ", ".join(f"{why} {count}" for why, count in sorted(self.dropped.items()))


class _Sent(NamedTuple):
    pieces: list[bytes]
    way: str | None
    """Of its damage; None: intact."""


def run(language: Language, n_damaged: int, seed: int) -> MakersFindings:
    """Send messages, half of them damaged, until so many were, or a few more."""
    rng, verdict, decoder = Random(f"makers {seed}"), MakersFindings(), language.decoder()
    known: dict[str, int] = {}
    awaited: dict[str, int] = {}
    before, since_damage = language.message(rng, 0), 0
    while verdict.damaged.total() < n_damaged:
        for _ in range(BLOCK):
            number = verdict.n_messages
            verdict.n_messages += 1
            data = language.message(rng, number)
            # Decoded alone, the message says what it must come out as.
            contents = list(map(repr, language.decoder().feed(data))) or [repr(data)]
            known.update(dict.fromkeys(contents, number))
            sent = (_damaged_on_can if language.is_can else _damaged)(rng, data, before)
            before = data
            found = _fed(
                decoder, sent.pieces, None if language.is_datagram or language.is_can else rng, verdict
            )
            verdict.n_accepted += len(found)
            since_damage = 0 if sent.way else since_damage + 1
            if sent.way is not None:
                verdict.damaged[sent.way] += 1
                last_way = sent.way
            # Anything that comes out and was never sent is damage that was not noticed.
            strange = [each for each in found if each not in known]
            if strange:
                verdict.corrupt[last_way] += 1
            # A decoder may lose a few messages after damage while it finds its place again.
            if since_damage > _RECOVERED:
                awaited.update(dict.fromkeys(contents, number))
            for each in found:
                awaited.pop(each, None)

        known = {content: number for content, number in known.items() if number > verdict.n_messages - BLOCK}
        verdict.lost += [content for content in awaited if content not in known]
        awaited = {content: number for content, number in awaited.items() if content in known}
    verdict.dropped = decoder.dropped
    return verdict


def _damaged(rng: Random, data: bytes, before: bytes) -> _Sent:
    if rng.random() >= _DAMAGED_SHARE:
        return _Sent([data], None)
    place = rng.randrange(len(BYTE_DAMAGES))
    return _Sent(BYTE_DAMAGES[place](rng, data, before), _WAYS[place])


def _damaged_on_can(rng: Random, data: bytes, before: bytes) -> _Sent:
    if rng.random() >= _DAMAGED_SHARE:
        return _Sent([data], None)
    place = rng.randrange(len(PIECE_DAMAGES))
    pieces, others = ([pack_can_records([f]) for f in unpack_can_records(each)] for each in (data, before))
    return _Sent([b"".join(PIECE_DAMAGES[place](rng, pieces, others))], _CAN_WAYS[place])


def _fed(decoder: _Decoder, pieces: list[bytes], rng: Random | None, verdict: MakersFindings) -> list[str]:
    """Feed pieces, each cut somewhere unless they are datagrams; return what came of them."""
    found: list[str] = []
    for piece in pieces:
        cut = len(piece) if rng is None else rng.randrange(len(piece) + 1)
        for part in (piece[:cut],) if rng is None else (piece[:cut], piece[cut:]):
            try:
                found += map(repr, decoder.feed(part))
            except Exception as error:  # whatever it is, it is a finding
                verdict.raised.append(f"{error!r} for {part.hex()}")
    return found


def main() -> None:
    """Run a campaign from the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m devices.emulators.faults.makers_campaign", description=__doc__
    )
    parser.add_argument("languages", nargs="*", default=[], help=", ".join(LANGUAGES))
    parser.add_argument("--damaged", type=int, default=1_000_000, help="messages, of twice as many")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    is_good = True
    for name in arguments.languages or LANGUAGES:
        begin = time.monotonic()
        verdict = run(LANGUAGES[name], arguments.damaged, arguments.seed)
        print(f"{name}, seed {arguments.seed}, {time.monotonic() - begin:.0f} s:", *verdict.lines(), sep="\n")
        for failures in (verdict.raised, verdict.lost):
            for failure in failures[:_SHOWN_FAILURES]:
                print(failure)
        is_good &= not (verdict.raised or verdict.lost)
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    main()
