"""Streams of whole bodies whose numbers begin anew, or are damaged, go on."""

import pytest

from devices.link import Chunk
from devices.vendor_protocols import mocopi, mvn
from gateway.body.rig import load_rig
from gateway.sources.mocopi import MocopiSource
from gateway.sources.module_table import ModuleTable
from gateway.sources.mvn import MvnSource
from gateway.sources.source import SourceContext

BEGUN = 300
FIRST = [(5000 + k, 1000 + 10 * k) for k in range(BEGUN)]
"""Number and time, ms, of each instant."""
LATER = [
    ("the program is started again", [(k, 1000 + 10 * (BEGUN + k)) for k in range(600)]),
    ("and tells its time from anew", [(k, 10 * k) for k in range(600)]),
    ("a bit of a number is turned", [(2**30, 4000), *[(5301 + k, 4010 + 10 * k) for k in range(599)]]),
    ("a lower one", [(5300 + 4096, 4000), *[(5301 + k, 4010 + 10 * k) for k in range(599)]]),
    ("a bit of a stamp is turned", [(5300, 4000 ^ 2**20), *[(5301 + k, 4010 + 10 * k) for k in range(599)]]),
    ("the time of day begins anew", [(5300 + k, 10 * k) for k in range(600)]),
    ("a minute is lost", [(11_300 + k, 64_000 + 10 * k) for k in range(600)]),
]


def of_mvn(number, time_ms):
    poses = [mvn.SegmentPose(segment, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)) for segment in range(1, 24)]
    return mvn.encode(mvn.QUATERNIONS, number, time_ms, poses)


def of_mocopi(number, time_ms):
    bones = tuple((bone, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for bone in range(27))
    return mocopi.encode(mocopi.Frame(number, time_ms, bones))


@pytest.mark.parametrize(
    ("source", "carries", "rig", "encoded"),
    [(MvnSource, "mvn", "mvn_fused_23", of_mvn), (MocopiSource, "mocopi", "mocopi_23", of_mocopi)],
)
@pytest.mark.parametrize(("what", "later"), LATER, ids=[what for what, _ in LATER])
def test_a_stream_goes_on_when(source, carries, rig, encoded, what, later):
    made = source(SourceContext(load_rig(rig), ModuleTable()))
    made.add_link("suit", carries)
    given = [
        len(made.receive(Chunk(encoded(number, time_ms), 10**18 + 10_000_000 * k, "suit")))
        for k, (number, time_ms) in enumerate(FIRST + later)
    ]
    assert all(given[:BEGUN])
    assert sum(count == 0 for count in given[BEGUN:]) <= 2
    dropped = made.dropped()["suit"]
    assert set(dropped) <= {"leap_in_number"}


@pytest.mark.parametrize(
    ("source", "carries", "rig", "encoded"),
    [(MvnSource, "mvn", "mvn_fused_23", of_mvn), (MocopiSource, "mocopi", "mocopi_23", of_mocopi)],
)
@pytest.mark.parametrize("bit", [10, 14, 20, 26])
def test_no_wrong_stamp_dates_an_instant(source, carries, rig, encoded, bit):
    made = source(SourceContext(load_rig(rig), ModuleTable()))
    made.add_link("suit", carries)
    dated = []
    for k in range(BEGUN):
        arrived_ns = 10**18 + 10_000_000 * k
        time_ms = 1000 + 10 * k
        wrong = encoded(5000 + k, time_ms ^ 2**bit if k == 200 else time_ms)
        dated += [each.time_ns - arrived_ns for each in made.receive(Chunk(wrong, arrived_ns, "suit"))]
    assert max(map(abs, dated)) < 20_000_000
    assert made.dropped()["suit"] == {"leap_in_number": 1}
