"""Wire frames too long for one set of CAN frames, in pieces, with flow control (after ISO 15765-2).

The whole is the wire frame as on a byte stream before stuffing, checksum included. Its pieces are wire
frames of their own (``TransferToModule`` from the host, ``TransferToHost`` from a module), all of the
size of the first but the last one. The receiver's flow control names the piece wanted next::

    sender                      receiver
    first (bytes of the whole)  ->
                                <-  continue at 1, 8 pieces, 0 between them
    consecutive 1 ... 8         ->
                                <-  continue at 9 ...          (or: wait; overflow; repeat from 5)
    consecutive 9 ... 16        ->
                                <-  done

Unlike in ISO 15765-2 a lost piece is asked for again. Both ends, ``TransferSender`` and
``TransferReceiver`` (pieces of many senders), are state machines that are told the time: ``receive``
takes a piece from the other end, ``due`` gives those to be sent by now, and ``next_time_ns`` says when
to ask again. They never raise for what they receive.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import NamedTuple

from firmware_protocol.codec import FieldsCodec
from firmware_protocol.fields import WireField
from firmware_protocol.framing import MAX_FRAME_SIZE, MIN_FRAME_SIZE, Defect, WireFrame, parse, serialize
from firmware_protocol.messages import MAX_PIECE_DATA_SIZE, TransferToHost, TransferToModule

TransferPiece = TransferToModule | TransferToHost


class PieceType(IntEnum):
    """What a piece is."""

    FIRST = 1
    CONSECUTIVE = 2
    FLOW_CONTROL = 3


class FlowStatus(IntEnum):
    """What flow control says."""

    CONTINUE = 0
    WAIT = 1
    OVERFLOW = 2
    DONE = 3
    REPEAT = 4


FLOW_CONTROL_FIELDS = (
    WireField(
        name="status",
        code="B",
        meanings={
            0: "continue with a block from the piece wanted next",
            1: "wait for more flow control",
            2: "give up: too long, or the checksum is wrong",
            3: "done: the whole has come",
            4: "repeat from the piece wanted next",
        },
        sentence="What the sender is to do.",
    ),
    WireField(name="block_size", code="B", sentence="Pieces until the next flow control; 0: all of them."),
    WireField(name="separation", code="H", unit="s", scale=1e-4, sentence="Least time between two pieces."),
)
"""The data of a flow-control piece."""

_FLOW_CONTROL = FieldsCodec(FLOW_CONTROL_FIELDS)


class FlowControl(NamedTuple):
    """What a receiver asks of a sender."""

    wanted: int
    """Place of the piece wanted next."""
    status: FlowStatus
    block_size: int = 0
    separation: float = 0.0
    """s"""


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferParams:
    """How patient both ends are, and how a receiver paces a sender."""

    piece_size: int = MAX_PIECE_DATA_SIZE
    """Bytes of the whole in one piece."""
    block_size: int = 8
    """Pieces between two flow controls; 0: no limit."""
    separation: float = 0.0
    """Least time between two pieces, s."""
    flow_timeout_ns: int = 200_000_000
    """How long a sender waits for flow control before it sends the last piece again."""
    piece_timeout_ns: int = 100_000_000
    """How long a receiver waits for a piece before it asks for it again."""
    max_retries: int = 8
    """Time-outs in a row after which either end gives up."""
    wait_interval_ns: int = 50_000_000
    """How often a busy receiver says so again."""
    max_waits: int = 200
    """Waits in a row after which a sender gives up."""


class TransferState(Enum):
    """How a sender's transfer stands."""

    SENDING = "on its way"
    DONE = "the receiver has all of it"
    REFUSED = "the receiver gave it up"
    TIMED_OUT = "the receiver does not answer"


def flow_control_piece(make: type[TransferPiece], transfer: int, flow: FlowControl) -> TransferPiece:
    """Return a piece that carries flow control."""
    data = _FLOW_CONTROL.encode(int(flow.status), flow.block_size, flow.separation)
    return make(PieceType.FLOW_CONTROL, transfer, flow.wanted, data)


def flow_control_of(piece: TransferPiece) -> FlowControl | None:
    """Return the flow control that a piece carries; None when it carries none. Never raises."""
    if piece.piece != PieceType.FLOW_CONTROL:
        return None
    values = _FLOW_CONTROL.decode(piece.data)
    return None if values is None else FlowControl(piece.number, FlowStatus(values[0]), values[1], values[2])


class TransferSender:
    """Sends one wire frame in pieces."""

    def __init__(
        self,
        frame: WireFrame,
        transfer: int,
        now_ns: int,
        make: type[TransferPiece] = TransferToModule,
        params: TransferParams | None = None,
    ) -> None:
        """Begin a transfer; ``transfer`` counts this sender's modulo 256, ``make`` says which way it goes.

        Raises ValueError as ``framing.serialize``.
        """
        self.state = TransferState.SENDING
        self._params = params or TransferParams()
        self._make = make
        self._transfer = transfer
        whole, size = serialize(frame), self._params.piece_size
        self._total = len(whole)
        self._data = [whole[start : start + size] for start in range(0, len(whole), size)]
        self._wanted = 0  # what the receiver asked for last
        self._next, self._limit = 0, 1  # piece to be sent next, and the one at which to wait
        self._is_granted = False  # the block from _wanted has been allowed
        self._separation_ns = 0
        self._time_ns = now_ns  # of the next piece, or at which patience ends
        self._retries = self._waits = 0

    @property
    def next_time_ns(self) -> int | None:
        """When to call ``due`` again at the latest; None when there is nothing more to send."""
        return self._time_ns if self.state is TransferState.SENDING else None

    def due(self, now_ns: int) -> list[TransferPiece]:
        """Return the pieces to be sent by now."""
        pieces: list[TransferPiece] = []
        while self.state is TransferState.SENDING and now_ns >= self._time_ns:
            # All that was allowed is sent, and the receiver has not answered in time.
            if self._next == self._limit and not self._retry():
                break
            pieces.append(self._piece(self._next))
            self._next += 1
            is_waiting = self._next == self._limit
            self._time_ns = now_ns + (self._params.flow_timeout_ns if is_waiting else self._separation_ns)
        return pieces

    def receive(self, piece: TransferPiece, now_ns: int) -> None:
        """Take the receiver's flow control; what is no part of this transfer is ignored."""
        flow = flow_control_of(piece)
        if flow is None or piece.transfer != self._transfer or self.state is not TransferState.SENDING:
            return
        if flow.status is FlowStatus.OVERFLOW:
            self.state = TransferState.REFUSED
        # What was confirmed before is not sent again: an older answer was overtaken on the bus.
        elif self._wanted <= flow.wanted <= len(self._data):
            self._follow(flow, now_ns)

    def _follow(self, flow: FlowControl, now_ns: int) -> None:
        if flow.wanted > self._wanted:
            # The receiver got further: it has as many retries and waits again as at the beginning.
            self._wanted, self._is_granted = flow.wanted, False
            self._retries = self._waits = 0
        if flow.status is FlowStatus.DONE:
            if flow.wanted == len(self._data):
                self.state = TransferState.DONE
        elif flow.status is FlowStatus.WAIT:
            self._wait(now_ns)
        # A block is allowed once: the same flow control, repeated, must not send its pieces twice.
        elif flow.status is FlowStatus.REPEAT or not self._is_granted:
            self._grant(flow, now_ns)

    def _grant(self, flow: FlowControl, now_ns: int) -> None:
        if flow.wanted == len(self._data):
            return  # nothing is left to send
        block = flow.block_size or len(self._data)
        self._next, self._limit = flow.wanted, min(flow.wanted + block, len(self._data))
        self._separation_ns = round(flow.separation * 1e9)
        self._is_granted, self._time_ns = True, now_ns

    def _wait(self, now_ns: int) -> None:
        self._waits += 1
        self._is_granted = False
        self._limit = self._next
        self._time_ns = now_ns + self._params.flow_timeout_ns
        self._retries = 0
        if self._waits > self._params.max_waits:
            self.state = TransferState.TIMED_OUT

    def _retry(self) -> bool:
        """Go back to the piece sent last, which makes the receiver say what it wants."""
        self._retries += 1
        if self._retries > self._params.max_retries:
            self.state = TransferState.TIMED_OUT
            return False
        self._next = max(self._next - 1, 0)
        return True

    def _piece(self, place: int) -> TransferPiece:
        kind, number = (PieceType.CONSECUTIVE, place) if place else (PieceType.FIRST, self._total)
        return self._make(kind, self._transfer, number, self._data[place])


MAX_TRANSFERS = 66
"""Senders at one time: 64 modules, the relay and the host."""


@dataclass(slots=True)
class _Reception:
    """One transfer as far as it has come."""

    first: TransferPiece
    n_pieces: int
    data: list[bytes]
    limit: int
    """Place at which the sender waits for flow control."""
    time_ns: int
    """When patience ends."""
    retries: int = 0
    has_asked: bool = False
    """Whether a gap before the piece wanted has been reported."""
    is_waiting: bool = False
    """Whether the sender was asked to wait."""
    is_done: bool = False


@dataclass
class TransferReceiver:
    """Receives the transfers of many senders, one at a time from each: at most 66 wire frames of 4 kB."""

    make: type[TransferPiece] = TransferToModule
    """Which way its flow control goes: by default to modules, so this is the host's end."""
    params: TransferParams = field(default_factory=TransferParams)
    is_busy: bool = False
    """While true, senders are asked to wait."""
    dropped: Counter[Defect] = field(default_factory=Counter)
    """Transfers given up, by reason."""
    accepted: int = 0
    """Wire frames handed out."""
    _receptions: dict[int, _Reception] = field(default_factory=dict)
    _answers: list[tuple[int, TransferPiece]] = field(default_factory=list)

    @property
    def next_time_ns(self) -> int | None:
        """When to call ``due`` again at the latest, when nothing is received before."""
        times = [reception.time_ns for reception in self._receptions.values() if not reception.is_done]
        return min(times, default=None)

    def receive(self, module: int, piece: TransferPiece, now_ns: int) -> WireFrame | None:
        """Return the wire frame that a piece under this module's header completes, if it completes one."""
        if piece.piece == PieceType.FIRST:
            return self._begin(module, piece, now_ns)
        reception = self._receptions.get(module)
        is_ours = reception is not None and reception.first.transfer == piece.transfer
        if reception is None or not is_ours or piece.piece != PieceType.CONSECUTIVE:
            return None
        return self._take(module, reception, piece, now_ns)

    def due(self, now_ns: int) -> list[tuple[int, TransferPiece]]:
        """Flow control to be sent by now, each piece with the module of its header."""
        for module, reception in list(self._receptions.items()):
            if not reception.is_done and now_ns >= reception.time_ns:
                self._time_out(module, reception, now_ns)
        answers, self._answers = self._answers, []
        return answers

    def _begin(self, module: int, first: TransferPiece, now_ns: int) -> WireFrame | None:
        known = self._receptions.get(module)
        if known is not None and known.first == first:
            if len(known.data) == 1:
                self._flow(module, known, now_ns)  # the answer to the first of these was lost
            return None
        if known is not None and not known.is_done:
            self.dropped[Defect.LOST_FRAGMENT] += 1
        self._receptions.pop(module, None)
        size, total = len(first.data), first.number
        is_good = MIN_FRAME_SIZE <= total <= MAX_FRAME_SIZE and 0 < size <= total
        if not is_good or len(self._receptions) >= MAX_TRANSFERS:
            self.dropped[Defect.OVERLONG if is_good or total > MAX_FRAME_SIZE else Defect.BAD_LENGTH] += 1
            self._answer(module, first.transfer, FlowControl(0, FlowStatus.OVERFLOW))
            return None
        # The pieces are of one size but for the last: so the first piece and the whole tell their number.
        begun = _Reception(first, -(-total // size), [first.data], 1, now_ns)
        self._receptions[module] = begun
        return self._go_on(module, begun, now_ns)

    def _take(
        self, module: int, reception: _Reception, piece: TransferPiece, now_ns: int
    ) -> WireFrame | None:
        wanted = len(reception.data)
        if piece.number < wanted:
            # The sender repeats the end of a block: it has not heard the answer to it.
            if piece.number == wanted - 1 and wanted == reception.limit:
                self._flow(module, reception, now_ns)
            return None
        size, total = len(reception.first.data), reception.first.number
        if piece.number >= reception.n_pieces or len(piece.data) != min(size, total - piece.number * size):
            return None  # the checksum of the piece was right: the sender is at fault, and asked again
        if piece.number > wanted:
            if not reception.has_asked:
                self._ask_again(module, reception, now_ns)
            return None
        reception.data.append(piece.data)
        reception.has_asked, reception.retries = False, 0
        reception.time_ns = now_ns + self.params.piece_timeout_ns
        return self._go_on(module, reception, now_ns)

    def _go_on(self, module: int, reception: _Reception, now_ns: int) -> WireFrame | None:
        """Finish after a piece that was wanted, or answer at the end of a block."""
        if len(reception.data) < reception.n_pieces:
            if len(reception.data) >= reception.limit:
                self._flow(module, reception, now_ns)
            return None
        entry = parse(b"".join(reception.data))
        reception.limit = len(reception.data)
        if type(entry) is Defect:
            del self._receptions[module]
            self.dropped[entry] += 1
            self._answer(module, reception.first.transfer, FlowControl(0, FlowStatus.OVERFLOW))
            return None
        # Kept until the sender begins another: the answer may be lost, and is then asked for again.
        reception.is_done = True
        reception.data = [b""] * reception.n_pieces  # only their number is still needed
        self.accepted += 1
        self._flow(module, reception, now_ns)
        return WireFrame(*entry)

    def _flow(self, module: int, reception: _Reception, now_ns: int) -> None:
        """Answer a sender at the end of a block how to go on."""
        wanted = len(reception.data)
        if reception.is_done:
            self._answer(module, reception.first.transfer, FlowControl(wanted, FlowStatus.DONE))
        elif self.is_busy:
            # WAIT is repeated at every interval: without it the sender's own time would run out.
            reception.is_waiting = True
            reception.time_ns = now_ns + self.params.wait_interval_ns
            self._answer(module, reception.first.transfer, FlowControl(wanted, FlowStatus.WAIT))
        else:
            self._allow(module, reception, FlowStatus.CONTINUE, now_ns)

    def _ask_again(self, module: int, reception: _Reception, now_ns: int) -> None:
        reception.has_asked = True
        self._allow(module, reception, FlowStatus.REPEAT, now_ns)

    def _allow(self, module: int, reception: _Reception, status: FlowStatus, now_ns: int) -> None:
        wanted, block = len(reception.data), self.params.block_size
        reception.is_waiting = False
        reception.limit = min(wanted + block, reception.n_pieces) if block else reception.n_pieces
        reception.time_ns = now_ns + self.params.piece_timeout_ns
        flow = FlowControl(wanted, status, block, self.params.separation)
        self._answer(module, reception.first.transfer, flow)

    def _time_out(self, module: int, reception: _Reception, now_ns: int) -> None:
        if reception.is_waiting:
            self._flow(module, reception, now_ns)
            return
        # A piece that was lost leaves no gap to be seen when it was the last of its block.
        reception.retries += 1
        if reception.retries > self.params.max_retries:
            del self._receptions[module]
            self.dropped[Defect.LOST_FRAGMENT] += 1
            return
        self._ask_again(module, reception, now_ns)

    def _answer(self, module: int, transfer: int, flow: FlowControl) -> None:
        self._answers.append((module, flow_control_piece(self.make, transfer, flow)))
