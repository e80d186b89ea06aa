"""A suit on one link and a satellite receiver on another: the pose stands where the receiver says."""

from __future__ import annotations

import heapq
from itertools import takewhile

import numpy as np

from devices.emulators.gnss_receiver import GnssEmulation, gnss_traffic
from devices.emulators.imperfections import Imperfections
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.cli.emulate import without_position_devices
from gateway.emulation.rig import dress, move
from gateway.pipeline import Pipeline
from gateway.sources.clock_mode import ClockMode
from gateway.sources.link_settings import GnssLinkSettings
from gateway.stages.frame_assembler import AssemblyParams

SECONDS = 6.0


def test_the_root_is_where_the_receiver_says():
    suit = load_rig("single_placed")
    worn = without_position_devices(suit)
    motion = move(dress(worn), "single", 1)
    traffic = SuitTraffic(motion, SuitSettings(gravity=suit.gravity), Imperfections(), 1)

    def path(t):
        return np.array([3.0, -2.0, 1.0]), np.zeros(3)

    emulation = GnssEmulation()
    fixes = takewhile(lambda s: s.time_s < SECONDS, gnss_traffic(path, 0, emulation, 1))
    receiver = GnssLinkSettings(name="gnss", url="/dev/null", latency_ms=50, origin=emulation.origin)
    pipeline = Pipeline(
        suit,
        AssemblyParams(10e6, 30_000_000, 10**8, 5 * 10**8),
        "gyro_free",
        ClockMode.ESTIMATED,
        links={"gnss": receiver},
    )
    pipeline.add_link("suit", Framing.BYTE_STREAM)
    pipeline.add_link("gnss", "gnss")
    chunks = heapq.merge(
        ((s.time_s, "suit", s.data) for s in traffic.transmissions(SECONDS)),
        ((s.time_s, "gnss", s.data) for s in fixes),
    )
    frames = [f for t, link, data in chunks for f in pipeline.feed(Chunk(data, round(t * 1e9), link))]
    np.testing.assert_allclose(np.mean([f.p_w[0] for f in frames[300:]], axis=0), [3.0, -2.0, 1.0], atol=0.03)
    assert pipeline.statistics()["gnss"]["gnss"]["state"] == "fix"
