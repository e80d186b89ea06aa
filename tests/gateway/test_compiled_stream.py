"""Kernels give what the readable way gives, bit for bit: readings, drops, balances, statistics."""

from __future__ import annotations

import gc
import json
import weakref
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.emulators.faults.wire_damage import BYTE_DAMAGES, PIECE_DAMAGES, ByteStream, CanBus, Source
from devices.link import Chunk, Framing, SentChunk
from firmware_protocol import (
    BROADCAST,
    Event,
    FusedSample,
    Health,
    InertialSample,
    InertialSampleFine,
    LightSample,
    Packet,
    SamplingTrigger,
    SyncRequest,
    WireFrame,
    encode_frame,
    fragment,
    pack_can_records,
    relay_batch,
    wire_frame,
)
from firmware_protocol.golden import VECTORS
from firmware_protocol.signing import SignedFrames
from gateway.clocks import ClockTable, TriggerAnswers
from gateway.clocks.module_clock import MOST_PACKETS
from gateway.emulation.both_ways import BothWays, BothWaysDiffer
from gateway.sources import compiled_decoding
from gateway.sources import suit as readable_way
from gateway.sources.clock_mode import ClockMode
from gateway.sources.module_table import ModuleTable
from gateway.sources.statistics import Cause
from gateway.sources.suit import SuitSource

START_NS = 1_800_000_000_000_000_000
MODULES = 5
RATES = np.linspace(0.9999, 1.0001, 30)
TABLE = ClockTable(0, tuple(range(MODULES)), 1.0, {m: RATES + 1e-5 * m for m in range(MODULES)})


def both_ways(mode=ClockMode.ESTIMATED, links=(("a", Framing.BYTE_STREAM),)):
    def make(is_compiled):
        triggers = TriggerAnswers(tuple(range(MODULES)), 40_000_000) if mode is ClockMode.TRIGGER else None
        table = TABLE if mode is ClockMode.TABLE else None
        return SuitSource(ModuleTable(mode, table, is_compiled=is_compiled), triggers)

    both = BothWays(make)
    for name, framing in links:
        both.add_link(name, framing)
    return both


def vectors_of(framing):
    """Wire bytes of the golden vectors, good ones and defects."""
    packets, defects = (json.loads((VECTORS / f"{name}.json").read_text()) for name in ("packets", "defects"))
    if framing is Framing.BYTE_STREAM:
        good = [vector["byte_stream"] for vector in packets["vectors"]]
        return [bytes.fromhex(text) for text in good + [each["input"] for each in defects["byte_stream"]]]
    forms = (vector[form] for vector in packets["vectors"] for form in ("can_classic", "can_fd"))
    good = [form["records"] for form in forms if form]
    return [bytes.fromhex(text) for text in good + [each["input"] for each in defects["can"]]]


@pytest.mark.parametrize("framing", list(Framing))
@pytest.mark.parametrize("mode", list(ClockMode))
def test_golden_vectors_one_by_one_and_all_together(framing, mode):
    data = vectors_of(framing)
    assert len(data) > 40
    both = both_ways(mode, [("a", framing)])
    for turn in range(3):
        for k, each in enumerate([*data, b"".join(data)]):
            both.receive(Chunk(each, START_NS + turn * 10**9 + k * 1_000_000, "a"))
            both.compare_accounts()
    if framing is Framing.BYTE_STREAM:
        for k, byte in enumerate(b"".join(data)):
            both.receive(Chunk(bytes([byte]), START_NS + 4 * 10**9 + k * 100_000, "a"))
    both.compare_accounts()


@pytest.mark.parametrize("framing", list(Framing))
@pytest.mark.parametrize("mode", [ClockMode.ESTIMATED, ClockMode.SHARED])
def test_what_was_fed_is_freed(framing, mode):
    stream = SuitSource(ModuleTable(mode))
    stream.add_link("a", framing)
    for data in vectors_of(framing):
        stream.receive(Chunk(data, START_NS, "a"))
    assert stream.modules
    parts = [stream, *stream._decoders.values(), *stream.modules.values()]
    parts += [record.clock for record in stream.modules.values()]
    known = [weakref.ref(part) for part in parts]
    del stream, parts
    gc.collect()
    assert [ref() for ref in known] == [None] * len(known)


@pytest.mark.parametrize("framing", list(Framing))
def test_a_slice_of_the_campaign(framing):
    """Damaged traffic of every kind; ``make soak`` runs ten million wire frames of it."""
    source = (ByteStream if framing is Framing.BYTE_STREAM else CanBus)(Random(7))
    both, now_ns = both_ways(links=[("a", framing)]), START_NS
    for _ in range(20):
        for chunk in source.block().chunks:
            now_ns += 1_000_000
            both.receive(Chunk(chunk, now_ns, "a"))
        both.compare_accounts()


class Modules:
    """Modules that sample, lose, repeat, overtake, restart and are damaged on their way, by chance."""

    def __init__(self, rng: Random) -> None:
        self.rng = rng
        self.now_ns = START_NS
        self.interval_ns = rng.choice((1_000_000, 10_000_000, 10_000_000, 100_000_000))
        self.is_relayed = rng.random() < 0.4
        self.damage = rng.choice((0.0, 0.0, 0.05, 0.3))
        self.loss = rng.choice((0.0, 0.02, 0.3))
        self.oddity = rng.choice((0.0, 0.01, 0.1))
        self.rates = [1 + rng.uniform(-3e-4, 3e-4) for _ in range(MODULES)]
        self.began_us = [rng.randrange(2**32) for _ in range(MODULES)]
        self.sequences = [{} for _ in range(MODULES)]
        self.held: list[WireFrame] = []
        self.kinds = rng.choice((["coarse"], ["coarse"], ["fine", "coarse"], ["coarse", "other"]))
        self.others = Source(rng, largest=200)

    def frames(self) -> list[WireFrame]:
        """What modules send at one instant, in the order in which it arrives."""
        rng, found = self.rng, []
        self.now_ns += self.interval_ns
        if rng.random() < self.oddity:
            self.now_ns += rng.choice((200_000_000, 3_000_000_000, 12_000_000_000))
        for module in range(MODULES):
            if rng.random() < self.oddity:
                self._befall(module)
            frame = self._frame(module)
            if rng.random() < self.loss:
                continue
            found.append(frame)
            if rng.random() < self.oddity:
                found.append(rng.choice((frame, rng.choice(found))))
            if rng.random() < self.oddity:
                self.held.append(found.pop())
        if self.held and rng.random() < 0.3:
            found.append(self.held.pop(rng.randrange(len(self.held))))
        return found

    def _befall(self, module: int) -> None:
        """A module restarts, or its counter or number jumps."""
        rng = self.rng
        if rng.random() < 0.3:
            self.sequences[module] = {}
        for kind in self.sequences[module]:
            self.sequences[module][kind] += rng.choice((0, 3, 300, 40_000))
        self.began_us[module] += rng.choice((0, 1_500_000, 2_500_000, -1_500_000, -2_500_000, 10**9))

    def _frame(self, module: int) -> WireFrame:
        rng = self.rng
        packet = self._packet()
        sequence = self.sequences[module].get(packet.KIND, 65_500) + 1
        self.sequences[module][packet.KIND] = sequence
        elapsed_us = (self.now_ns - START_NS) * 1e-3 * self.rates[module]
        stamp_us = int(self.began_us[module] + elapsed_us - rng.expovariate(1e-3)) % 2**32
        return wire_frame(packet, module, sequence % 65536, stamp_us)

    def _packet(self) -> Packet:
        rng = self.rng
        kind = rng.choice(self.kinds)
        if kind == "other":
            choices = (Health(None, None, None, None, 1, 2, 3, 4, 5), Event(2), LightSample((0.1,) * 6))
            return rng.choice((*choices, FusedSample((1.0, 0.0, 0.0, 0.0), (0.0,) * 3, 0.01)))
        present = [rng.random() < 0.9 for _ in range(3)]
        force, field, rate = (
            tuple(rng.uniform(-reach, reach) for _ in range(3)) if is_there else None
            for is_there, reach in zip(present, (200.0, 100.0, 40.0), strict=True)
        )
        cls = InertialSample if kind == "coarse" else InertialSampleFine
        return cls(force, field, rate, triggered=rng.random() < 0.2)

    def chunks(self, framing: Framing) -> list[bytes]:
        """The bytes of one instant, as a link might hand them over."""
        rng, frames = self.rng, self.frames()
        if self.is_relayed and framing is Framing.BYTE_STREAM and frames:
            frames = [relay_batch(frames, 0, self.now_ns // 1000 % 2**32)]
        if framing is Framing.CAN:
            pieces = [[pack_can_records([p]) for p in fragment(f, rng.random() < 0.3)] for f in frames]
            whole = list(pieces)
            for k in range(len(pieces)):
                if rng.random() < self.damage:
                    pieces[k] = rng.choice(PIECE_DAMAGES)(rng, whole[k], whole[k - 1])
            if rng.random() < 0.3:  # lower identifiers cut in
                pieces = [[piece for k in range(20) for each in pieces for piece in each[k : k + 1]]]
            return [b"".join(piece for each in pieces for piece in each)]
        encoded = [encode_frame(frame) for frame in frames]
        whole = list(encoded)
        for k in range(len(encoded)):
            if rng.random() < self.damage:
                encoded[k] = b"".join(rng.choice(BYTE_DAMAGES)(rng, whole[k], whole[k - 1]))
        data = b"".join(encoded)
        if rng.random() < 0.3 or not data:
            return encoded
        cut = rng.randrange(len(data))
        return [data[:cut], data[cut:]] if rng.random() < 0.5 else [data]


def host_chunk(rng: Random, link: str, framing: Framing, now_ns: int, number: int) -> SentChunk:
    packet = SamplingTrigger(number) if rng.random() < 0.7 else SyncRequest(number, 5)
    frame = wire_frame(packet, BROADCAST, number, 0)
    data = encode_frame(frame) if framing is Framing.BYTE_STREAM else pack_can_records(fragment(frame))
    return SentChunk(data, now_ns, link)


@pytest.mark.parametrize("mode", list(ClockMode))
@given(seed=st.integers(0, 2**32))
@settings(max_examples=20, deadline=None)
def test_streams_by_chance(mode, seed):
    rng = Random(seed)
    links = [("a", rng.choice(list(Framing))), ("b", Framing.BYTE_STREAM)]
    both = both_ways(mode, links)
    for heard in rng.sample((InertialSample, InertialSampleFine, Health, Event), rng.choice((0, 0, 1, 2))):
        both.listen(heard)
    suits = {name: Modules(rng) for name, _ in links}
    for step in range(rng.choice((20, 60, 200))):
        for name, framing in links:
            suit = suits[name]
            if rng.random() < 0.1:
                both.sent(host_chunk(rng, name, framing, suit.now_ns, step))
            if rng.random() < 0.02:
                both.readable.table.notice(name, cause := rng.choice(list(Cause)))
                both.compiled.table.notice(name, cause)
            for data in suit.chunks(framing):
                sender = rng.choice(("", "", "10.0.0.5:7000", "10.0.0.6:7000")) if name == "b" else ""
                late_ns = rng.choice((0, 500_000, 20_000_000))
                both.receive(Chunk(data, suit.now_ns + late_ns, name, sender))
        if step % 50 == 0:
            both.compare_accounts()
    both.compare_accounts()


@pytest.mark.parametrize("mode", [ClockMode.ESTIMATED, ClockMode.SHARED])
def test_the_usual_samples_never_become_packets(mode, monkeypatch):
    """Else the rest of this file would compare the readable way with itself."""
    both, taken, take = both_ways(mode), [], SuitSource._take

    def noting(stream, packet, chunk):
        taken.append(stream)
        take(stream, packet, chunk)

    for k in range(4):
        both.receive(plain_chunk(k))
    monkeypatch.setattr(SuitSource, "_take", noting)
    for k in range(4, 9):
        both.receive(plain_chunk(k, interval_ms=1))
    assert len(taken) == 15
    assert set(taken) == {both.readable}


def plain_chunk(k, module_ids=(0, 1, 2), interval_ms=10):
    packet = InertialSample((0.0, 0.0, 9.81), (20.0, 0.0, 40.0), (0.1, 0.2, 0.3))
    frames = [wire_frame(packet, module, k % 65536, k * interval_ms * 1000) for module in module_ids]
    return Chunk(b"".join(map(encode_frame, frames)), START_NS + k * interval_ms * 1_000_000, "a")


def test_a_block_ends_with_its_many_packets():
    both = both_ways()
    for k in range(3 * MOST_PACKETS):
        both.receive(plain_chunk(k, (0, 1), interval_ms=1))
    both.compare_accounts()


def test_a_chunk_larger_than_any_before():
    both = both_ways()
    for n in (1, 300, 3000):
        data = b"".join(plain_chunk(k).data for k in range(n))
        both.receive(Chunk(data, START_NS + n * 1_000_000_000, "a"))
    both.compare_accounts()


def test_a_bytearray_is_as_good_as_bytes():
    both = both_ways()
    data = plain_chunk(0).data
    both.receive(Chunk(bytearray(data[:20]), START_NS, "a"))
    assert both.receive(Chunk(bytearray(data[20:]), START_NS, "a"))


def test_what_was_signed_is_the_same_once_opened():
    rng, both = Random(5), both_ways()
    sender, receiver = SignedFrames(bytes(32), 3, 10**6), SignedFrames(bytes(32), count=10)
    for k in range(300):
        data = sender.sign(plain_chunk(k).data)
        if rng.random() < 0.2:
            at = rng.randrange(len(data))
            data = data[:at] + data[at + 1 :]
        both.receive(Chunk(receiver.feed(data), START_NS + k * 10_000_000, "a"))
    assert receiver.dropped
    assert both.compiled.modules[0].lost > 10
    both.compare_accounts()


def test_links_with_many_senders_keep_their_bytes_apart():
    both = both_ways()
    for k in range(200):
        data, sender = plain_chunk(k, (k % 3,)).data, f"10.0.0.{k % 3}:7000"
        for part in (data[:11], data[11:]):
            both.receive(Chunk(part, START_NS + k * 1_000_000, "a", sender))
        both.receive(Chunk(b"\x07", START_NS + k * 1_000_000, "a", f"10.0.1.{k}:1"))
    assert len(both.compiled.senders("a")) == 3
    both.compare_accounts()


def broken(monkeypatch, where, name, altered):
    real = getattr(where, name)
    monkeypatch.setattr(where, name, lambda *arguments: altered(real, *arguments))


def loses_an_entry(real, *arguments):
    used, n = real(*arguments)
    return used, n - (n > 2)


def changes_the_last_bit(real, *arguments):
    at, n_samples, n_events = real(*arguments)
    if n_samples:
        samples = arguments[6]["measured"]
        samples[n_samples - 1, 0, 2] = np.nextafter(samples[n_samples - 1, 0, 2], 0.0)
    return at, n_samples, n_events


def is_late(real, record, packet, sequence, time_ns):
    sample = real(record, packet, sequence, time_ns)
    return sample._replace(time_ns=sample.time_ns + 1)


@pytest.mark.parametrize(
    ("where", "name", "altered"),
    [
        (compiled_decoding, "decode_stream", loses_an_entry),
        (compiled_decoding, "follow", changes_the_last_bit),
        (readable_way, "_reading", is_late),
    ],
)
def test_a_way_that_is_wrong_is_found(where, name, altered, monkeypatch):
    broken(monkeypatch, where, name, altered)
    both = both_ways()
    with pytest.raises(BothWaysDiffer, match="readings"):
        receive_some(both)


def receive_some(both):
    for k in range(10):
        both.receive(plain_chunk(k))


def test_counts_that_differ_are_found():
    both = both_ways()
    both.receive(plain_chunk(0))
    both.compare_accounts()
    both.readable.modules[0].sequences[InertialSample.KIND].duplicates += 1
    with pytest.raises(BothWaysDiffer, match="balances"):
        both.compare_accounts()
