"""Samples of an MTi that is asked something meanwhile."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from devices.emulators.makers.mti import MtiEmulator
from devices.emulators.makers.vendor_emulator import Sensed
from devices.link import Chunk
from devices.vendor_protocols.mti import Mid, encode
from firmware_protocol import InertialSample
from gateway.body.rig import load_rig
from gateway.sources.module_table import ModuleTable
from gateway.sources.mti import MtiSource
from gateway.sources.source import SourceContext

BEGUN_NS = 10**18
DEVICE = SimpleNamespace(adopt=lambda _settings: None)


@pytest.mark.parametrize("is_counted", [True, False])
def test_what_it_did_not_measure_while_it_was_asked_is_not_lost(is_counted):
    modules = ModuleTable()
    source = MtiSource(SourceContext(load_rig("arm_3"), modules))
    source.add_link("mti", "mti")
    emulator = MtiEmulator(0)
    if not is_counted:
        del emulator.outputs["packet_counter"]

    def heard(number, data):
        return source.receive(Chunk(data, BEGUN_NS + 10_000_000 * number, "mti"))

    rows = []
    for number in range(200):
        if number in (50, 60):
            mid = Mid.GO_TO_CONFIG if number == 50 else Mid.GO_TO_MEASUREMENT
            heard(number, emulator.receive(encode(mid), DEVICE))
        if number == 120:  # this one does get lost
            continue
        said = emulator.encode_sample(Sensed(10_000 * number, number, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0), None))
        rows += heard(number, said)
    counter = modules.records[0].counter(InertialSample.KIND)
    assert (counter.received, counter.lost) == (189, 1)
    assert sum(map(len, rows)) == 189
