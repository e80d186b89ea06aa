"""A slice of the fuzz campaign, and proof that it notices decoders that are wrong."""

from __future__ import annotations

import os
import sys
from zlib import crc32

import pytest

from devices.emulators.faults import wire_campaign
from firmware_protocol import CanFrameDecoder, Defect, FrameDecoder
from firmware_protocol.framing import Entry

N_FRAMES = 1_000_000 if os.environ.get("CI") else 100_000
"""``make soak`` runs ten million; continuous integration a tenth of them."""


@pytest.mark.timeout(900)
def test_damaged_wire_frames_among_good_ones():
    verdict = wire_campaign.run(N_FRAMES, seed=20)
    assert verdict.is_good, verdict.line()
    assert verdict.n_damaged > 0.25 * N_FRAMES
    assert verdict.n_accepted > 0.8 * N_FRAMES
    counted = {Defect.BAD_CRC, Defect.BAD_STUFFING, Defect.OVERLONG, Defect.TOO_SHORT, Defect.BAD_LENGTH}
    counted |= {Defect.FOREIGN, Defect.LOST_FRAGMENT, Defect.TRUNCATED, Defect.UNKNOWN_KIND}
    assert counted == set(verdict.dropped)


class SlowToResync(FrameDecoder):
    """Loses the wire frame after each one that it drops."""

    def entries(self, chunk: bytes) -> list[Entry]:
        before = sum(self.dropped.values())
        entries = super().entries(chunk)
        return entries[1:] if sum(self.dropped.values()) > before else entries


class Fragile(CanFrameDecoder):
    """Raises for what it should drop."""

    def entries(self, chunk: bytes) -> list[Entry]:
        entries = super().entries(chunk)
        if self.dropped[Defect.LOST_FRAGMENT]:
            raise IndexError("no such piece")
        return entries


def test_a_decoder_that_does_not_look_at_the_checksum_is_found(monkeypatch: pytest.MonkeyPatch):
    framing = sys.modules["firmware_protocol.framing"]
    monkeypatch.setattr(framing, "crc32", lambda content: crc32(content) if len(content) > 40 else Any32())
    verdict = wire_campaign.run(2_000, seed=1)
    assert verdict.corrupt
    assert not verdict.is_good
    assert verdict.line().startswith("FAIL")


class Any32(int):
    """A checksum that fits everything."""

    def __eq__(self, other: object) -> bool:
        return True

    def __ne__(self, other: object) -> bool:
        return False

    __hash__ = int.__hash__

    def __index__(self) -> int:
        return 0


def test_a_decoder_that_is_slow_to_resync_is_found():
    verdict = wire_campaign.run(2_000, seed=1, byte_stream=SlowToResync)
    assert verdict.lost
    assert not verdict.corrupt


def test_a_decoder_that_raises_is_found():
    verdict = wire_campaign.run(2_000, seed=1, can=Fragile)
    assert "IndexError" in verdict.raised[0]


@pytest.mark.parametrize(("decoder", "code"), [(FrameDecoder, 0), (SlowToResync, 1)])
def test_the_exit_code_says_it(
    decoder: type[FrameDecoder],
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setattr(sys, "argv", ["wire_campaign", "--frames", "1000", "--seed", "3"])
    monkeypatch.setattr(wire_campaign.run, "__defaults__", (lambda _: None, decoder, CanFrameDecoder))
    with pytest.raises(SystemExit) as ended:
        wire_campaign.main()
    assert ended.value.code == code
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("FAIL" if code else "PASS")
