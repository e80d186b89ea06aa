"""A slice of the campaign for every maker's protocol, and proof that it notices decoders that are wrong."""

from __future__ import annotations

import os

import pytest

from devices.emulators.faults import makers_campaign
from devices.emulators.faults.makers_campaign import LANGUAGES, Language, run
from devices.vendor_protocols.ximu3 import Ximu3Decoder

N_DAMAGED = 60_000 if os.environ.get("CI") else 6_000
MOST_CORRUPT = {
    "ximu3": 0.10, "ximu3_text": 0.05, "mti": 0.01, "slimevr": 0.04, "mti_can": 0.30, "witmotion": 0.04,
    "witmotion_can": 0.16, "mvn": 0.15, "bno08x_rvc": 0.01, "mocopi": 0.08,
}  # fmt: skip
"""Of the damaged, accepted as something else: what their own checks let through, and a little."""


@pytest.mark.parametrize("name", LANGUAGES)
def test_nothing_raises_nothing_intact_is_lost_and_little_damaged_is_accepted(name):
    verdict = run(LANGUAGES[name], N_DAMAGED, seed=20)
    told = "\n".join(verdict.lines())
    assert not verdict.raised, verdict.raised[0]
    assert not verdict.lost, verdict.lost[0]
    assert verdict.n_accepted > 0.95 * (verdict.n_messages - verdict.damaged.total()), told
    assert verdict.corrupt_share < MOST_CORRUPT[name], told


class _Fragile(Ximu3Decoder):
    def feed(self, data):
        if b"\xdb\x00" in data:
            raise ValueError("what is this?")
        return super().feed(data)


class _SlowToRecover(Ximu3Decoder):
    def feed(self, data):
        dropped = self.dropped.total()
        found = super().feed(data)
        return found if self.dropped.total() == dropped and dropped % 3 else []


@pytest.mark.parametrize(("decoder", "finding"), [(_Fragile, "raised"), (_SlowToRecover, "lost")])
def test_a_decoder_that_is_wrong_is_found_out(decoder, finding):
    wrong = Language(decoder, LANGUAGES["ximu3"].message)
    assert getattr(run(wrong, 2500, seed=1), finding)


def test_it_is_run_from_the_command_line(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["campaign", "--damaged", "150", "ximu3"])
    with pytest.raises(SystemExit, match="0"):
        makers_campaign.main()
    assert "0 exceptions, 0 intact lost" in capsys.readouterr().out
