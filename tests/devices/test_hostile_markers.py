"""Markers over the network: whoever can reach the port may send anything."""

from __future__ import annotations

import orjson
import pytest

from devices.link import Chunk
from devices.marker_messages import MarkerReceiver

MESSAGE = orjson.dumps({"sequence": 1, "markers": {"A": [1.0, 2.0, 3.0]}, "unlabelled": [[1, 1, 1]]})


@pytest.mark.parametrize("unit", [[], {}, ["m"], 1, None, True, "furlong"])
def test_a_unit_that_is_no_text_is_dropped(unit):
    """A list once raised TypeError out of a receiver that never raises."""
    receiver = MarkerReceiver()
    data = orjson.dumps({"unit": unit, "markers": {"A": [1, 2, 3]}}) + b"\n"
    assert receiver.receive(Chunk(data, 1, "optical")) == []
    assert receiver.dropped == {"bad_unit": 1}


@pytest.mark.parametrize("at", range(1, len(MESSAGE)))
def test_a_stream_may_be_cut_after_a_brace(at):
    """The part before the cut is no datagram of its own."""
    receiver = MarkerReceiver()
    found = receiver.receive(Chunk(MESSAGE[:at], 1, "optical"))
    found += receiver.receive(Chunk(MESSAGE[at:] + b"\n", 2, "optical"))
    assert [message.sequence for message in found] == [1]
    assert not receiver.dropped


def test_a_datagram_without_a_newline_is_a_message():
    assert len(MarkerReceiver().receive(Chunk(MESSAGE, 1, "optical"))) == 1
