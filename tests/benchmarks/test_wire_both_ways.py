"""A slice of the campaign that holds kernels against the readable way, and proof that it notices."""

from __future__ import annotations

import sys

import pytest

from benchmarks import wire_both_ways
from gateway.sources import can_kernels, compiled_decoding, wire_layout
from gateway.sources.clock_mode import ClockMode


@pytest.mark.parametrize("mode", [ClockMode.SHARED, ClockMode.ESTIMATED])
def test_damaged_wire_frames_among_good_ones(mode):
    account = wire_both_ways.run(6_000, seed=20, mode=mode)
    assert account.damaged > 0.25 * account.frames
    assert account.packets > 0.8 * account.frames
    assert account.readings > 1_000
    reasons = {"bad_crc", "bad_stuffing", "overlong", "too_short", "bad_length", "foreign", "lost_fragment"}
    assert reasons | {"truncated", "unknown_kind"} == set(account.dropped)


def forgets_a_loss(real):
    def decode(*arguments):
        decoder = arguments[1]
        before = decoder["dropped"][0, wire_layout.LOST_FRAGMENT]
        n = real(*arguments)
        if decoder["dropped"][0, wire_layout.LOST_FRAGMENT] > before + 1:
            decoder["dropped"][0, wire_layout.LOST_FRAGMENT] -= 1
        return n

    return decode


def test_a_drop_that_is_not_counted_ends_with_one(monkeypatch):
    monkeypatch.setattr(compiled_decoding, "decode_records", forgets_a_loss(can_kernels.decode_records))
    monkeypatch.setattr(sys, "argv", ["wire_both_ways", "--frames", "2000"])
    with pytest.raises(SystemExit, match="FAIL: dropped"):
        wire_both_ways.main()


def test_the_verdict_says_what_went_both_ways(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["wire_both_ways", "--frames", "1000", "--seed", "3"])
    wire_both_ways.main()
    assert capsys.readouterr().out.startswith("PASS: 1024 wire frames (")
