"""Where people will be, told to cameras; whatever else comes is nothing."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.cameras.heat_map_messages import FOUND_BY_CAMERA
from devices.cameras.orders import LONGEST, encode_orders, read_orders


def test_each_camera_reads_its_own():
    line = encode_orders(812, {"a": {3: (540.0, 910.5, 700.25, 0.5), 4: None}, "b": {}})
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    orders = read_orders(line, "a")
    assert orders.sequence == 812
    assert orders.squares == {3: (540.0, 910.5, 700.25, 0.5), 4: None}
    assert read_orders(line, "b").squares == {}
    assert read_orders(line, "c") is None


@pytest.mark.parametrize(
    "squares",
    [
        {"1": [0, 0, 0, 0]},
        {"1": [0, 0, 1e9, 0]},
        {"1": [float("nan"), 0, 100, 0]},
        {"1": [0, 0, 100]},
        {"-1": None},
        {str(FOUND_BY_CAMERA): None},
        {"x": None},
        {str(k): None for k in range(40)},
        [1],
        None,
    ],
)
def test_what_is_no_square_is_nothing(squares):
    line = json.dumps({"sequence": 1, "cameras": {"a": squares}}).encode()
    assert read_orders(line, "a") is None


@given(st.binary(max_size=200))
@settings(max_examples=200, deadline=None)
def test_anything_else_is_nothing(line):
    assert read_orders(line, "a") is None
    assert read_orders(b"[" * LONGEST, "a") is None
    assert read_orders(b" " * LONGEST + b"{}", "a") is None
