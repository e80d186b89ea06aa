"""Settings and versions: bytes by hand, limits, factory values."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol import (
    SETTINGS,
    SUPPORTED,
    VersionRange,
    decode_value,
    encode_value,
    factory_settings,
    negotiate,
)

seeded = settings(deadline=None, derandomize=True)


@pytest.mark.parametrize(
    ("key", "value", "data"),
    [
        (1, 63, b"\x3f"),
        (2, 100.0, b"\xe8\x03"),
        (2, 4000.0, b"\x40\x9c"),
        (3, 156.9, b"\x21\x06"),
        (4, math.radians(2000), b"\xd0\x07"),
        (5, 4900.0, b"\x24\x13"),
        (6, 0.0, b"\x00\x00"),
        (7, 41.3, b"\x9d\x01"),
        (8, 3, b"\x03"),
        (9, (0.5,) * 30, struct.pack("<30f", *[0.5] * 30)),
        (10, "épaule", b"\xc3\xa9paule" + bytes(9)),
        (10, "", bytes(16)),
        (10, "sixteen letters.", b"sixteen letters."),
    ],
)
def test_values_are_those_worked_out_by_hand(key: int, value: Any, data: bytes):
    assert encode_value(key, value) == data
    decoded = decode_value(key, data)
    assert decoded == (value if isinstance(value, str) else pytest.approx(value))


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        (0, 1, "setting 0: there are 1 module_id"),
        (1, 64, "module_id"),
        (2, 0.9, "sampling_rate"),
        (2, 4000.1, "sampling_rate"),
        (2, math.nan, "sampling_rate"),
        (3, 9.9, "accelerometer_range"),
        (4, math.radians(4001), "gyroscope_range"),
        (5, 99.0, "magnetometer_range"),
        (6, -0.1, "accelerometer_low_pass"),
        (8, 0, "mode"),
        (8, 4, "mode"),
        (9, (0.5,) * 29, "calibration.*30 numbers"),
        (9, (math.inf,) * 30, "calibration"),
        (10, "seventeen letters", "label.*16 bytes"),
        (10, "a\x00b", "label.*zero"),
        (10, b"bytes", "label.*text"),
    ],
)
def test_a_value_outside_the_limits_is_refused_by_name(key: int, value: Any, named: str):
    with pytest.raises(ValueError, match=named):
        encode_value(key, value)


@pytest.mark.parametrize(
    ("key", "data"),
    [
        (0, b""),
        (99, b"\x01"),
        (1, b""),
        (1, b"\x40"),
        (1, b"\x00\x00"),
        (2, b"\x09\x00"),
        (2, b"\x41\x9c"),
        (8, b"\x00"),
        (9, struct.pack("<30f", *[math.nan] * 30)),
        (9, bytes(119)),
        (10, bytes(15)),
        (10, b"\xff" * 16),
        (10, b"a\x00b" + bytes(13)),
    ],
)
def test_bytes_that_are_no_value_are_none(key: int, data: bytes):
    assert decode_value(key, data) is None


@pytest.mark.parametrize("key", SETTINGS)
def test_the_factory_value_lies_within_the_limits_and_round_trips(key: int):
    setting = SETTINGS[key]
    data = encode_value(key, setting.factory)
    assert len(data) == setting.value.size
    assert decode_value(key, data) == setting.factory == factory_settings()[key]
    assert setting.value.sentence.endswith(".")


def test_the_factory_calibration_changes_nothing():
    calibration = factory_settings()[9]
    for start in (0, 15):
        assert calibration[start : start + 9] == (1, 0, 0, 0, 1, 0, 0, 0, 1)
    assert not any(calibration[9:15] + calibration[24:27])


@seeded
@given(st.integers(0, 255), st.binary(max_size=130) | st.binary(min_size=1, max_size=2))
def test_any_bytes_never_raise_and_what_decodes_encodes_to_them(key: int, data: bytes):
    value = decode_value(key, data)
    if value is not None:
        assert encode_value(key, value) == data


@seeded
@given(st.sampled_from([key for key in SETTINGS if SETTINGS[key].value.code == "H"]), st.integers(0, 65535))
def test_every_number_within_the_limits_round_trips(key: int, number: int):
    declared, data = SETTINGS[key].value, number.to_bytes(2, "little")
    value = decode_value(key, data)
    low, high = (declared.minimum or 0.0), declared.maximum
    assert (value is not None) == (low <= number * declared.scale <= high)
    if value is not None:
        assert encode_value(key, value) == data


@pytest.mark.parametrize(
    ("one", "other", "chosen"),
    [
        ((1, 1), (1, 1), 1),
        ((1, 3), (2, 5), 3),
        ((2, 5), (1, 3), 3),
        ((1, 9), (4, 4), 4),
        ((1, 1), (2, 2), None),
        ((3, 4), (1, 2), None),
        ((2, 1), (1, 2), None),
        ((0, 0), (0, 0), None),
    ],
)
def test_the_highest_common_version_is_chosen(
    one: tuple[int, int], other: tuple[int, int], chosen: int | None
):
    assert negotiate(one, other) == negotiate(other, one) == chosen


@seeded
@given(*[st.tuples(st.integers(1, 9), st.integers(1, 9))] * 2)
def test_negotiation_is_the_greatest_common_member(one: tuple[int, int], other: tuple[int, int]):
    common = set(range(one[0], one[1] + 1)) & set(range(other[0], other[1] + 1))
    assert negotiate(VersionRange(*one), other) == max(common, default=None)


def test_this_package_agrees_with_itself():
    assert negotiate(SUPPORTED, SUPPORTED) == 1
