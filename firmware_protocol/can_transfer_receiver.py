"""The receiving end of ``can_transfer``: pieces of many senders back to their wire frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from firmware_protocol.can_transfer import (
    FlowControl,
    FlowStatus,
    PieceType,
    TransferParams,
    TransferPiece,
    flow_control_piece,
)
from firmware_protocol.framing import MAX_FRAME_SIZE, MIN_FRAME_SIZE, Defect, WireFrame, parse
from firmware_protocol.messages import TransferToModule

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
