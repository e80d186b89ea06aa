"""Signed wire frames: what is refused, what comes late and passes once, how two ends find one count."""

from __future__ import annotations

import json
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol import DELIMITER, Defect, FrameDecoder, WireFrame, encode_frame
from firmware_protocol.golden import GOOD, KEY, VECTORS, signing_vectors
from firmware_protocol.signing import SENT_SIGNATURE_SIZE, WINDOW, SignedFrames

MODULE = 0x00A1B2C3
SENT = encode_frame(GOOD)
frames = st.builds(
    WireFrame,
    kind=st.integers(0, 255),
    module=st.integers(0, 63),
    sequence=st.integers(0, 65535),
    module_time_us=st.integers(0, 2**32 - 1),
    body=st.binary(max_size=600),
)


def module(count=0):
    return SignedFrames(KEY, MODULE, count)


def test_golden_vectors_are_committed():
    """To bring them up to date: python -m firmware_protocol.golden."""
    assert json.loads((VECTORS / "signing.json").read_text(encoding="utf-8")) == signing_vectors()


@given(st.lists(frames, max_size=5), st.data())
def test_what_is_signed_is_opened_however_it_is_cut(sent, data):
    plain = b"".join(map(encode_frame, sent))
    signed = module().sign(plain)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(signed)), max_size=6)))
    host = SignedFrames(KEY)
    parts = [signed[a:b] for a, b in zip([0, *cuts], [*cuts, len(signed)], strict=True)]
    assert b"".join(map(host.feed, parts)) == plain
    assert not host.dropped
    assert SignedFrames(KEY).open(signed) == plain


@given(frames, st.data())
def test_any_turned_bit_is_refused(frame, data):
    signed = bytearray(module().sign(encode_frame(frame)))
    bit = data.draw(st.integers(0, 8 * len(signed) - 1))
    signed[bit // 8] ^= 1 << bit % 8
    for host in (SignedFrames(KEY), SignedFrames(KEY)):
        assert host.open(bytes(signed)) == b""
        assert host.dropped.total() >= 1
        assert set(host.dropped) <= {Defect.BAD_SIGNATURE, Defect.UNSIGNED}
    assert SignedFrames(KEY).feed(bytes(signed)) == b""


@given(st.binary(max_size=200))
def test_what_nobody_signed_is_refused_and_raises_nothing(junk):
    host = SignedFrames(KEY)
    assert host.open(junk) == b""
    assert host.feed(junk) == b""
    host.restart()
    assert host.feed(module().sign(SENT)) == SENT


@given(st.permutations(range(40)), st.lists(st.integers(0, 39)))
def test_in_any_order_each_passes_once(order, repeated):
    signer, host = module(), SignedFrames(KEY)
    signed = [signer.sign(SENT) for _ in order]
    assert all(host.open(signed[n]) == SENT for n in order)
    assert not any(host.open(signed[n]) for n in repeated)
    assert host.dropped[Defect.REPLAYED] == len(repeated)


def test_of_the_window_the_last_passes_and_the_one_behind_does_not():
    signer, host = module(), SignedFrames(KEY)
    signed = [signer.sign(SENT) for _ in range(WINDOW + 1)]
    assert host.open(signed[-1]) == SENT
    assert host.open(signed[1]) == SENT
    assert host.open(signed[0]) == b""
    assert host.dropped == {Defect.OUTDATED: 1}


def test_a_jump_of_any_length_is_taken_and_costs_no_memory():
    host = SignedFrames(KEY)
    assert host.open(module().sign(SENT)) == SENT
    assert host.open(module(2**48 - 2).sign(SENT)) == SENT
    assert host.open(module().sign(SENT)) == b""


def test_signers_count_each_for_itself():
    host = SignedFrames(KEY)
    for number in range(1, 6):
        assert host.open(SignedFrames(KEY, number).sign(SENT)) == SENT
    assert not host.dropped


def test_what_was_signed_before_the_start_is_refused_after_it():
    """A recorded stream, sent again to a gateway that has been started anew."""
    old = module(1000)
    recorded = [old.sign(SENT) for _ in range(3)]
    host = SignedFrames(KEY, count=5000)
    assert not any(map(host.open, recorded))
    assert host.dropped == {Defect.OUTDATED: 3}


def test_a_module_without_a_clock_is_heard_after_one_answer():
    """Also after it restarts, and then its old wire frames are worth nothing."""
    host = SignedFrames(KEY, count=10**9)
    for _ in range(2):
        restarted = module()
        assert host.open(first := restarted.sign(SENT)) == b""
        assert host.owes_count
        assert restarted.open(host.sign(DELIMITER)) == b""
        assert host.open(second := restarted.sign(SENT)) == SENT
        assert not host.owes_count
        assert not host.open(first)
        assert not host.open(second)


def test_a_host_whose_clock_was_set_back_is_heard_again():
    stored = module()
    stored.open(SignedFrames(KEY, count=10**9).sign(SENT))
    host = SignedFrames(KEY, count=1000)
    assert stored.open(host.sign(SENT)) == b""
    assert host.open(stored.sign(SENT)) == SENT
    assert stored.open(host.sign(SENT)) == SENT


def test_neither_end_takes_its_own_nor_a_module_what_another_one_signed():
    host, first = SignedFrames(KEY), module()
    assert host.open(SignedFrames(KEY).sign(SENT)) == b""
    assert first.open(SignedFrames(KEY, MODULE + 1).sign(SENT)) == b""
    assert host.dropped == first.dropped == {Defect.BAD_SIGNATURE: 1}


def test_bytes_of_one_datagram_never_join_those_of_another():
    signed = module().sign(SENT)
    host = SignedFrames(KEY)
    assert host.open(signed[:SENT_SIGNATURE_SIZE]) == b""
    assert host.open(signed[SENT_SIGNATURE_SIZE:]) == b""


def test_noise_without_an_end_is_bounded_and_counted_once():
    host = SignedFrames(KEY)
    rng = random.Random(1)
    for _ in range(50):
        assert host.feed(rng.randbytes(1000).replace(DELIMITER, b"\x01")) == b""
    assert host.feed(DELIMITER + module().sign(SENT)) == SENT
    assert host.dropped == {Defect.OVERLONG: 1}


def test_without_a_key_the_wire_frames_are_still_read():
    """The signature is a block of its own: a receiver without a key drops it and reads on."""
    decoder = FrameDecoder()
    assert decoder.feed(module().sign(SENT + SENT)) == [GOOD, GOOD]
    assert decoder.dropped == {Defect.BAD_CRC: 2}


@pytest.mark.parametrize("size", [0, 31, 33])
def test_a_key_has_32_bytes(size):
    with pytest.raises(ValueError, match="32 bytes"):
        SignedFrames(bytes(size))


def test_a_key_is_used_up_after_2_to_the_48():
    with pytest.raises(OverflowError):
        module(2**48 - 1).sign(SENT)
