"""Reports of a BNO08x in UART-RVC mode: that of the data sheet, round trips, and bytes that are none."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.vendor_protocols.bno08x import Bno08xDecoder, Report, encode

OF_THE_DATA_SHEET = bytes.fromhex("AAAADE010092FF25088DFEECFFD103000000E7")
reports = st.builds(
    Report,
    st.integers(0, 255),
    st.tuples(st.integers(-18000, 18000), st.integers(-9000, 9000), st.integers(-18000, 18000)).map(
        lambda each: tuple(value / 100 for value in each)
    ),
    st.tuples(*[st.integers(-8000, 8000)] * 3).map(lambda each: tuple(value / 1000 for value in each)),
)


def test_the_report_of_the_data_sheet_is_read_as_it_says():
    decoder = Bno08xDecoder()
    (report,) = decoder.feed(OF_THE_DATA_SHEET)
    assert report == Report(0xDE, (0.01, -1.10, 20.85), (-0.371, -0.020, 0.977))
    assert encode(report) == OF_THE_DATA_SHEET


@given(reports, st.lists(st.integers(1, 12)))
def test_reports_come_back_however_the_bytes_are_cut(report, cuts):
    data, decoder, found = encode(report), Bno08xDecoder(), []
    for cut in [*cuts, len(data)]:
        found += decoder.feed(data[:cut])
        data = data[cut:]
    assert found == [report]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (OF_THE_DATA_SHEET[:-1] + b"\xe8", "bad_checksum"),
        (b"\x01\xaa\x02", "noise"),
        (encode(Report(1, (181.0, 0, 0), (0, 0, 1))), "no_angle"),
        (encode(Report(1, (0, 0, 0), (0, 0, 9.5))), "force_beyond_sensor"),
    ],
)
def test_what_cannot_be_is_dropped_and_counted_by_reason(data, reason):
    decoder = Bno08xDecoder()
    assert decoder.feed(data) == []
    assert len(decoder.feed(OF_THE_DATA_SHEET)) == 1
    assert reason in decoder.dropped


@given(st.binary(max_size=200))
def test_no_bytes_raise(data):
    Bno08xDecoder().feed(data)
