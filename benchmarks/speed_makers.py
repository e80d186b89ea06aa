"""What the messages of other makers' modules cost, from bytes to samples in gateway time, on one core."""

from __future__ import annotations

import time

from benchmarks.figures import Figure
from devices.emulators.delivery import Encoding
from devices.emulators.device.sampling import FUSED, RAW
from devices.emulators.makers.registry import VENDOR_EMULATORS
from devices.emulators.motion.motions import generic_motion
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, SentChunk
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.emulation.rig import dress
from gateway.frames import InertialBatch
from gateway.sources.makers import MakersSource
from gateway.sources.module_table import ModuleTable
from gateway.sources.registry import source_kind
from gateway.sources.source import SourceContext

_RIGS = {"mvn": "mvn_17", "mocopi": "mocopi_23"}
MAKERS = {maker: _RIGS.get(maker, "single") for maker in VENDOR_EMULATORS}
"""With the rig whose modules speak."""
SECONDS = 30.0
REPEATS = 5
FROM = 0.5
"""Share of the chunks after which time is taken: clocks are known then."""
_STEP_S = 0.05
_LINK, _SENDER = "module", "127.0.0.1:4210"


def figures() -> list[Figure]:
    """Return the time of a sample by maker, every message in a chunk of its own; MVN and mocopi send those of
    a whole suit in one."""
    chunks = {maker: _chunks(maker) for maker in MAKERS}
    best = dict.fromkeys(MAKERS, float("inf"))
    for _ in range(REPEATS):
        for maker in MAKERS:
            best[maker] = min(best[maker], _sample_us(maker, chunks[maker]))
    what = "one sample of a module that speaks {}, bytes to gateway time, in plain Python"
    return [Figure(f"{maker}_sample_us", us, "µs", "", what.format(maker)) for maker, us in best.items()]


def _numbers(suit: WornSuit) -> list[int]:
    return [suit.module_ids[row] for row in suit.module_of_segment.tolist() if row >= 0]


def _source(maker: str) -> MakersSource:
    suit, kind = load_rig(MAKERS[maker]), source_kind(maker)
    module, emulator = next(iter(VENDOR_EMULATORS[maker](_numbers(suit), 49.0).items()))
    device = dict(emulator.link_settings) if emulator.shares_link else {"module": module}
    if emulator.sends_as_one:
        device = {"module": 0}
    link = kind.settings.model_validate(
        {"name": _LINK, "url": "udp://0.0.0.0:7000", "carries": maker, **device}
    )
    source = kind.make(SourceContext(suit, ModuleTable(), links={_LINK: link}))
    assert isinstance(source, MakersSource)
    source.add_link(_LINK, maker)
    return source


def _chunks(maker: str) -> list[Chunk]:
    """What a module sends that is answered as by a gateway."""
    suit, source = load_rig(MAKERS[maker]), _source(maker)
    emulators = VENDOR_EMULATORS[maker](_numbers(suit), 49.0)
    first = next(iter(emulators.values()))
    settings = SuitSettings(
        emulator=emulators.__getitem__,
        encoding=Encoding(first.framing),
        mode=FUSED if first.is_fused else RAW,
    )
    traffic = SuitTraffic(generic_motion(dress(suit), 1), settings)
    chunks: list[Chunk] = []
    for step in range(1, int(SECONDS / _STEP_S)):
        now_s = step * _STEP_S
        for sent in traffic.advance(now_s):
            chunks.append(Chunk(sent.data, int(1e9 * sent.time_s), _LINK, _SENDER))
            source.receive(chunks[-1])
        for data, _ in source.devices[_LINK].due(int(1e9 * now_s)):
            source.sent(SentChunk(data, int(1e9 * now_s), _LINK))
            traffic.receive(data, now_s)
    return chunks


def _sample_us(maker: str, chunks: list[Chunk]) -> float:
    source, first = _source(maker), int(FROM * len(chunks))
    for chunk in chunks[:first]:
        source.receive(chunk)
    begin, samples = time.process_time(), 0
    for chunk in chunks[first:]:
        found = source.receive(chunk)
        samples += sum(len(each) if isinstance(each, InertialBatch) else 1 for each in found)
    return 1e6 * (time.process_time() - begin) / samples


if __name__ == "__main__":
    for figure in figures():
        print(figure.line())
