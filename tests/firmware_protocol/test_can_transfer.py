"""Long wire frames in pieces: through loss, repetition, disorder, waits and silence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol import (
    CanFrameDecoder,
    Defect,
    Kind,
    PacketDecoder,
    TransferToHost,
    TransferToModule,
    WireFrame,
    fragment,
    pack_can_records,
    wire_frame,
)
from firmware_protocol.can_transfer import (
    MAX_TRANSFERS,
    FlowControl,
    FlowStatus,
    TransferParams,
    TransferPiece,
    TransferReceiver,
    TransferSender,
    TransferState,
    flow_control_of,
    flow_control_piece,
)
from firmware_protocol.framing import MAX_BODY_SIZE, MAX_FRAME_SIZE

seeded = settings(deadline=None, derandomize=True)

MS = 1_000_000
MODULE = 254


def long_frame(size: int = 3000, sequence: int = 1) -> WireFrame:
    return WireFrame(0x20, MODULE, sequence, 99, Random(sequence).randbytes(size))


FRAME = long_frame()


class Channel:
    """Carries pieces with a delay, and does to each what it is told: 0 loses it, 2 doubles it."""

    def __init__(self, copies: Callable[[], int] = lambda: 1, delay: Callable[[], int] = lambda: MS) -> None:
        self._copies, self._delay = copies, delay
        self.underway: list[tuple[int, TransferPiece]] = []

    def send(self, piece: TransferPiece, now_ns: int) -> None:
        self.underway += [(now_ns + self._delay(), piece) for _ in range(self._copies())]

    def arrived(self, now_ns: int) -> list[TransferPiece]:
        due = sorted((time, n) for n, (time, _) in enumerate(self.underway) if time <= now_ns)
        pieces = [self.underway[n][1] for _, n in due]
        self.underway = [item for item in self.underway if item[0] > now_ns]
        return pieces


def carry(
    sender: TransferSender,
    receiver: TransferReceiver,
    there: Channel,
    back: Channel,
    until: Callable[[int], None] = lambda _: None,
    start_ns: int = 0,
) -> list[WireFrame]:
    """Runs both ends millisecond by millisecond until the sender is done, and a second longer."""
    frames: list[WireFrame] = []
    now, idle = start_ns, 0
    while idle < 1000:
        until(now)
        for piece in sender.due(now):
            there.send(piece, now)
        for piece in there.arrived(now):
            frame = receiver.receive(MODULE, piece, now)
            frames += [frame] if frame else []
        for module, answer in receiver.due(now):
            assert module == MODULE
            back.send(answer, now)
        for answer in back.arrived(now):
            sender.receive(answer, now)
        idle += sender.state is not TransferState.SENDING
        now += MS
    return frames


def test_a_transfer_by_hand():
    params = TransferParams(piece_size=100, block_size=2, separation=0.002)
    sender = TransferSender(long_frame(400), 5, 0, TransferToHost, params)
    receiver = TransferReceiver(params=params)
    (first,) = sender.due(0)
    assert (first.piece, first.transfer, first.number, len(first.data)) == (1, 5, 413, 100)
    assert first.data[:3] == bytes([1, 0x20, MODULE])
    assert sender.due(MS) == []
    assert receiver.receive(MODULE, first, 0) is None
    ((module, answer),) = receiver.due(0)
    assert (module, answer) == (MODULE, TransferToModule(3, 5, 1, bytes([0, 2, 20, 0])))
    sender.receive(answer, 0)
    (second,) = sender.due(0)
    assert (second.piece, second.number, len(second.data)) == (2, 1, 100)
    assert sender.due(MS) == []
    assert sender.next_time_ns == 2 * MS
    (third,) = sender.due(2 * MS)
    assert third.number == 2
    assert sender.due(50 * MS) == []
    for piece in (second, third):
        assert receiver.receive(MODULE, piece, 3 * MS) is None
    ((_, answer),) = receiver.due(3 * MS)
    assert flow_control_of(answer) == (3, FlowStatus.CONTINUE, 2, 0.002)
    sender.receive(answer, 4 * MS)
    last = [*sender.due(4 * MS), *sender.due(6 * MS)]
    assert [len(piece.data) for piece in last] == [100, 13]
    assert [receiver.receive(MODULE, piece, 7 * MS) for piece in last] == [None, long_frame(400)]
    ((_, answer),) = receiver.due(7 * MS)
    assert answer == TransferToModule(3, 5, 5, bytes([3, 0, 0, 0]))
    sender.receive(answer, 8 * MS)
    assert sender.state is TransferState.DONE
    assert (sender.next_time_ns, receiver.next_time_ns) == (None, None)


@pytest.mark.parametrize("size", [0, 1, 227, 228, 229, 469, 470, 3000, MAX_BODY_SIZE])
@pytest.mark.parametrize("block_size", [0, 1, 8])
def test_wire_frames_of_every_size_arrive_whole(size: int, block_size: int):
    params = TransferParams(block_size=block_size)
    sender = TransferSender(long_frame(size), 1, 0, TransferToHost, params)
    assert carry(sender, TransferReceiver(params=params), Channel(), Channel()) == [long_frame(size)]
    assert sender.state is TransferState.DONE


@pytest.mark.parametrize("lost", range(14))
@pytest.mark.parametrize("copies", [0, 2])
def test_any_one_piece_may_be_lost_or_repeated(lost: int, copies: int):
    """Thirteen pieces, in blocks of four."""
    for way in range(2):
        counts = [iter([1] * lost + [copies] + [1] * 1000), iter([1] * 1000)]
        there, back = (Channel(lambda count=count: next(count)) for count in (counts[way], counts[1 - way]))
        params = TransferParams(block_size=4)
        sender = TransferSender(FRAME, 1, 0, TransferToHost, params)
        assert carry(sender, TransferReceiver(params=params), there, back) == [FRAME]
        assert sender.state is TransferState.DONE


@pytest.mark.parametrize("seed", range(60))
def test_through_loss_repetition_and_disorder_of_both_ways(seed: int):
    rng = Random(seed)
    channels = [
        Channel(
            lambda: rng.choices((0, 1, 2), (0.15, 0.7, 0.15))[0],
            lambda: rng.randrange(1, 30) * MS,
        )
        for _ in range(2)
    ]
    params = TransferParams(
        piece_size=rng.choice((41, 241)), block_size=rng.choice((0, 1, 3, 8)), max_retries=40
    )
    receiver = TransferReceiver(params=params)
    for transfer in range(3):
        frame = long_frame(rng.randrange(MAX_BODY_SIZE), sequence=transfer)
        sender = TransferSender(frame, transfer, transfer * 10**12, TransferToHost, params)
        assert carry(sender, receiver, *channels, start_ns=transfer * 10**12) == [frame]
        assert sender.state is TransferState.DONE
    assert receiver.accepted == 3
    assert not receiver.dropped


@pytest.mark.parametrize("seed", range(20))
def test_a_poor_line_delivers_the_wire_frame_or_nothing(seed: int):
    rng = Random(seed)
    channels = [Channel(lambda: rng.choices((0, 1, 2), (0.6, 0.3, 0.1))[0]) for _ in range(2)]
    params = TransferParams(max_retries=3)
    sender, receiver = TransferSender(FRAME, 1, 0, TransferToHost, params), TransferReceiver(params=params)
    frames = carry(sender, receiver, *channels)
    assert frames in ([], [FRAME])
    if sender.state is TransferState.DONE:
        assert frames == [FRAME]


def test_a_silent_receiver_is_given_up_after_the_stated_time():
    params = TransferParams(max_retries=3, flow_timeout_ns=100 * MS)
    sender = TransferSender(FRAME, 1, 0, TransferToHost, params)
    times = [now for now in range(0, 1000 * MS, 10 * MS) if sender.due(now)]
    assert times == [0, 100 * MS, 200 * MS, 300 * MS]
    assert sender.state is TransferState.TIMED_OUT
    assert sender.next_time_ns is None


def test_a_silent_sender_is_given_up_and_counted():
    params = TransferParams(max_retries=3, piece_timeout_ns=100 * MS)
    receiver = TransferReceiver(params=params)
    (first,) = TransferSender(FRAME, 1, 0, TransferToHost, params).due(0)
    receiver.receive(MODULE, first, 0)
    answers = [flow_control_of(a) for now in range(0, 1000 * MS, 10 * MS) for _, a in receiver.due(now)]
    assert [flow and flow.status for flow in answers] == [FlowStatus.CONTINUE, *[FlowStatus.REPEAT] * 3]
    assert receiver.dropped == {Defect.LOST_FRAGMENT: 1}
    assert receiver.next_time_ns is None


def test_a_busy_receiver_makes_the_sender_wait_and_no_longer():
    receiver = TransferReceiver(is_busy=True)
    sender = TransferSender(FRAME, 1, 0, TransferToHost)

    def free_after_three_seconds(now_ns: int) -> None:
        receiver.is_busy = now_ns < 3000 * MS

    assert carry(sender, receiver, Channel(), Channel(), until=free_after_three_seconds) == [FRAME]
    assert sender.state is TransferState.DONE


def test_busy_in_the_middle_of_a_transfer():
    receiver = TransferReceiver(params=TransferParams(block_size=2))
    sender = TransferSender(FRAME, 1, 0, TransferToHost)

    def busy_for_a_while(now_ns: int) -> None:
        receiver.is_busy = 4 * MS < now_ns < 900 * MS

    assert carry(sender, receiver, Channel(), Channel(), until=busy_for_a_while) == [FRAME]


def test_a_sender_does_not_wait_for_ever():
    receiver = TransferReceiver(is_busy=True)
    sender = TransferSender(FRAME, 1, 0, TransferToHost, TransferParams(max_waits=10))
    assert carry(sender, receiver, Channel(), Channel()) == []
    assert sender.state is TransferState.TIMED_OUT


@pytest.mark.parametrize("total", [0, 12, MAX_FRAME_SIZE + 1, 65535])
def test_a_transfer_too_long_or_too_short_is_refused(total: int):
    receiver = TransferReceiver()
    assert receiver.receive(MODULE, TransferToHost(1, 9, total, bytes(10)), 0) is None
    ((_, answer),) = receiver.due(0)
    flow = flow_control_of(answer)
    assert flow is not None
    assert flow.status is FlowStatus.OVERFLOW
    assert sum(receiver.dropped.values()) == 1


def test_overflow_ends_the_sender():
    sender = TransferSender(FRAME, 9, 0, TransferToHost)
    sender.due(0)
    sender.receive(flow_control_piece(TransferToModule, 9, FlowControl(0, FlowStatus.OVERFLOW)), 0)
    assert sender.state is TransferState.REFUSED
    assert sender.due(10**12) == []


def test_a_wrong_checksum_is_refused_and_nothing_is_handed_out():
    params = TransferParams(piece_size=100)
    sender, receiver = TransferSender(FRAME, 1, 0, TransferToHost, params), TransferReceiver(params=params)
    spoilt = Channel()
    send = spoilt.send
    spoilt.send = lambda piece, now: send(  # type: ignore[method-assign]
        replace(piece, data=bytes(100)) if piece.piece == 2 and piece.number == 4 else piece, now
    )
    assert carry(sender, receiver, spoilt, Channel()) == []
    assert sender.state is TransferState.REFUSED
    assert receiver.dropped == {Defect.BAD_CRC: 1}


def test_many_senders_interleaved():
    frames = {module: long_frame(1000 + module, module) for module in range(64)}
    senders = {m: TransferSender(f, m, 0, TransferToHost) for m, f in frames.items()}
    receiver, received = TransferReceiver(), {}
    for now in range(0, 100 * MS, MS):
        for module, sender in senders.items():
            for piece in sender.due(now):
                frame = receiver.receive(module, piece, now)
                if frame:
                    received[module] = frame
        for module, answer in receiver.due(now):
            senders[module].receive(answer, now)
    assert received == frames
    assert {sender.state for sender in senders.values()} == {TransferState.DONE}


def test_a_new_transfer_ends_the_one_before():
    receiver = TransferReceiver()
    (first,) = TransferSender(FRAME, 1, 0, TransferToHost).due(0)
    receiver.receive(MODULE, first, 0)
    other = TransferSender(long_frame(2000, 2), 2, 0, TransferToHost)
    assert carry(other, receiver, Channel(), Channel()) == [long_frame(2000, 2)]
    assert receiver.dropped == {Defect.LOST_FRAGMENT: 1}


def test_the_same_number_may_be_used_again_for_another_wire_frame():
    receiver = TransferReceiver()
    for sequence in range(3):
        sender = TransferSender(long_frame(sequence=sequence), 0, 0, TransferToHost)
        assert carry(sender, receiver, Channel(), Channel()) == [long_frame(sequence=sequence)]


def test_the_memory_of_a_receiver_is_bounded():
    receiver = TransferReceiver()
    for module in range(256):
        receiver.receive(module, TransferToHost(1, 0, 4096, bytes(241)), 0)
    assert sum(receiver.dropped.values()) == 256 - MAX_TRANSFERS


def test_pieces_pass_over_a_can_bus_as_wire_frames_of_their_own():
    """A relay batch of 3000 bytes from a relay to the host, over classic CAN."""
    sender, receiver, decoder = (
        TransferSender(FRAME, 1, 0, TransferToHost),
        TransferReceiver(),
        CanFrameDecoder(),
    )
    packets, came = PacketDecoder(decoder), []
    for now in range(0, 50 * MS, MS):
        for n, piece in enumerate(sender.due(now)):
            assert piece.KIND == Kind.TRANSFER_TO_HOST
            chunk = pack_can_records(fragment(wire_frame(piece, MODULE, n, 0)))
            for received in packets.feed(chunk):
                assert isinstance(received.packet, TransferToHost)
                came.append(receiver.receive(received.module, received.packet, now))
        for _, answer in receiver.due(now):
            assert answer.KIND == Kind.TRANSFER_TO_MODULE
            sender.receive(answer, now)
    assert [frame for frame in came if frame] == [FRAME]
    assert not packets.dropped


pieces = st.builds(
    st.sampled_from([TransferToHost, TransferToModule]).flatmap,
    st.just(
        lambda make: st.builds(
            make,
            st.integers(1, 3),
            st.integers(0, 2),
            st.integers(0, 20) | st.integers(0, 65535),
            st.binary(max_size=5) | st.binary(max_size=241),
        )
    ),
).flatmap(lambda strategy: strategy)


@seeded
@given(st.lists(st.tuples(pieces, st.integers(0, 10**9)), max_size=30))
def test_arbitrary_pieces_never_raise(traffic: list[tuple[TransferPiece, int]]):
    sender, receiver = TransferSender(FRAME, 1, 0, TransferToHost), TransferReceiver()
    now = 0
    for piece, wait_ns in traffic:
        now += wait_ns
        sender.receive(piece, now)
        receiver.receive(MODULE, piece, now)
        assert len(sender.due(now)) <= 20
        receiver.due(now)
    fresh = TransferSender(long_frame(2000, 2), 77, now, TransferToHost)
    assert carry(fresh, receiver, Channel(), Channel(), start_ns=now) == [long_frame(2000, 2)]
