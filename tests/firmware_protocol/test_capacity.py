"""Capacity of lines: frame lengths worked out by hand, and what fits."""

import pytest

from firmware_protocol import InertialSample, encode_frame, wire_frame
from firmware_protocol.capacity import Traffic, can_frame_seconds, can_load, uart_load

FULL = InertialSample((0.0, 0.0, 9.8), (20.0, 0.0, -40.0), (0.1, 0.2, 0.3))
WITHOUT_MAGNETOMETER = InertialSample((0.0, 0.0, 9.8), None, (0.1, 0.2, 0.3))


def test_a_classic_frame_of_8_bytes_is_at_most_160_bits():
    # 54 + 64 stuffed bits, at most (118 - 1) // 4 = 29 stuff bits, 13 bits after them: the textbook's figure
    assert can_frame_seconds(8, 1_000_000) == pytest.approx(160e-6)
    assert can_frame_seconds(0, 500_000) == pytest.approx((54 + 13 + 13) / 500_000)


def test_an_fd_frame_changes_its_rate_for_the_data():
    slow = can_frame_seconds(32, 1_000_000, 1_000_000)
    fast = can_frame_seconds(32, 1_000_000, 4_000_000)
    data_bits = 5 + 256 + 261 // 4 + 4 + 21 + 7
    assert slow - fast == pytest.approx(data_bits * (1 - 1 / 4) / 1_000_000)
    assert can_frame_seconds(16, 10**6, 10**6) < can_frame_seconds(20, 10**6, 10**6)


def test_17_modules_at_100_hz_do_not_fit_classic_can_but_fit_fd():
    suit = [Traffic(FULL, 17, 100)]
    assert can_load(suit, 1_000_000) == pytest.approx(17 * 100 * (3 * 160 + 139) * 1e-6, rel=0.02)
    assert can_load(suit, 1_000_000) > 1.0
    assert can_load(suit, 1_000_000, 4_000_000) < 0.4
    assert can_load([Traffic(WITHOUT_MAGNETOMETER, 17, 100)], 1_000_000) < 0.85  # three full frames each


def test_uart_counts_ten_bits_for_every_byte_sent():
    sent = len(encode_frame(wire_frame(FULL, 0, 0, 0)))
    assert uart_load([Traffic(FULL, 17, 100)], 1_000_000) == pytest.approx(sent * 10 * 1700 / 1e6)
    assert uart_load([Traffic(FULL, 17, 100)], 460_800) > 1.0


def test_a_relay_saves_the_heads():
    suit = [Traffic(FULL, 17, 100)]
    assert uart_load(suit, 1_000_000, has_relay=True) < 0.9 * uart_load(suit, 1_000_000)
