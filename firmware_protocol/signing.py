"""Signed wire frames on a byte stream: a signature before each, by a key that both ends have. Sans-I/O.

Before the stuffed wire frame, which stays as it is, goes a block, stuffed and delimited like one::

    [mark:1] [signer:4] [count:6] [tag:8]

The tag is keyed BLAKE2s (RFC 7693) over mark, signer, count, and the wire frame as sent: stuffed, with its
delimiter. Nothing is parsed before its tag was found right. Both ends count what they sign upwards, and take
no count twice. Neither needs a clock for that: each takes over the other's count where that is higher.
"""

from __future__ import annotations

import hmac
import struct
from collections import Counter
from hashlib import blake2s

from firmware_protocol.fields import WireField
from firmware_protocol.framing import DELIMITER, MAX_STUFFED_SIZE, Defect
from firmware_protocol.stuffing import stuff

KEY_SIZE = 32
TAG_SIZE = 8
COUNT_SIZE = 6
MARK = 0x81
"""No wire frame begins so: its first byte is the version."""
HOST_SIGNER = 0

SIGNATURE_FIELDS = (
    WireField(name="mark", code="B", sentence=f"{MARK}: this is a signature, and no wire frame."),
    WireField(
        name="signer",
        code="I",
        sentence="Who signs. 0: the host. A module: CRC-32 of its unique id; never 0.",
    ),
    WireField(
        name="count", code="s", count=COUNT_SIZE, sentence="A whole number that the signer counts upwards."
    ),
    WireField(name="tag", code="s", count=TAG_SIZE, sentence="Keyed BLAKE2s, as below."),
)
SIGNATURE_SIZE = sum(f.size for f in SIGNATURE_FIELDS)
SENT_SIGNATURE_SIZE = SIGNATURE_SIZE + 2
"""As sent: stuffed, with its delimiter."""

WINDOW = 1024
"""Counts by which a wire frame may come behind its signer's newest: datagrams overtake one another."""

_SIGNED_SIZE = SIGNATURE_SIZE - TAG_SIZE
_COUNT_AT = _SIGNED_SIZE - COUNT_SIZE
_SIGNED = struct.Struct("<xIIH")
"""Signer, and the count in two parts."""
_WINDOW_MASK = (1 << WINDOW) - 1


class SignedFrames:
    """One end of a signed byte stream: signs what it sends, opens what comes.

    Bytes from the wire are untrusted: ``open`` and ``feed`` never raise, they count what they drop.
    """

    def __init__(self, key: bytes, signer: int = HOST_SIGNER, count: int = 0) -> None:
        """Hold one end's key and counts.

        signer: who this end is; ``HOST_SIGNER`` accepts all others, others accept it alone.
        count: what comes must be above it, and what is sent goes on from it. The host gives the time; a
        module the newest count that it has stored.

        Raises ``ValueError`` for a key of another size than 32 bytes.
        """
        if len(key) != KEY_SIZE:
            raise ValueError(f"a key has {KEY_SIZE} bytes, not {len(key)}")
        self.signer = signer
        self.count = count
        """Newest that was signed or, where it was higher, found right."""
        self.dropped: Counter[Defect] = Counter()
        """What was dropped, by reason."""
        self.owes_count = False
        """Whether what was opened last held something outdated, but rightly signed: its signer has lost
        count, and finds it again by anything that is signed here (``sign(DELIMITER)`` will do)."""
        self._floor = count
        self._is_host = signer == HOST_SIGNER
        self._keyed = blake2s(key=key, digest_size=TAG_SIZE)
        self._head = bytes([MARK]) + signer.to_bytes(_COUNT_AT - 1, "little")
        self._newest: dict[int, tuple[int, int]] = {}
        """By signer, its newest count, and which of those before it came: one bit each, newest lowest."""
        self._partial, self._skipping = b"", False
        self._signature: bytes | None = None  # of the wire frame that comes next

    def sign(self, data: bytes) -> bytes:
        """Return whole wire frames as sent, each with its signature before it.

        Raises OverflowError after 2^48 of them: the key has been used up.
        """
        *frames, rest = data.split(DELIMITER)
        return b"".join([self._signed(frame + DELIMITER) for frame in frames]) + rest

    def open(self, datagram: bytes) -> bytes:
        """Return the wire frames of a datagram whose signatures are right and new, as sent. Keeps nothing."""
        self._signature = None
        opened, rest = self._open(datagram)
        if rest:
            self.dropped[Defect.UNSIGNED] += 1
        return opened

    def feed(self, chunk: bytes) -> bytes:
        """Return the same of a stream in chunks of any size. Holds at most one stuffed wire frame between
        them."""
        if self._skipping:
            _, delimiter, chunk = chunk.partition(DELIMITER)
            self._skipping = not delimiter
        opened, self._partial = self._open(self._partial + chunk if self._partial else chunk)
        if self._skipping or len(self._partial) > MAX_STUFFED_SIZE:
            self._skip()
        return opened

    def restart(self) -> None:
        """Forget an unfinished wire frame: a new connection begins. Counts stay."""
        self._partial, self._signature, self._skipping = b"", None, False

    def _skip(self) -> None:
        if not self._skipping:
            self.dropped[Defect.OVERLONG] += 1
        self._partial, self._signature, self._skipping = b"", None, True

    def _signed(self, frame: bytes) -> bytes:
        count = self.count + 1
        signed = self._head + count.to_bytes(COUNT_SIZE, "little")
        keyed = self._keyed.copy()
        keyed.update(signed + frame)
        self.count = count
        return stuff(signed + keyed.digest()) + DELIMITER + frame

    def _open(self, data: bytes) -> tuple[bytes, bytes]:
        """Return what is right of whole blocks, and the bytes after the last of them."""
        opened: list[bytes] = []
        begin = 0
        self.owes_count = False
        while (end := data.find(DELIMITER, begin) + 1) > 0:
            block = data[begin:end]
            begin = end
            signature = self._signature
            if signature is None:
                # A lone delimiter is an idle line, and no wire frame without signature.
                if len(block) > 1:
                    self._signature = signature = _signature_in(block)
                    if signature is None:
                        self.dropped[Defect.UNSIGNED] += 1
                continue
            defect = self._verify(signature, block)
            if defect is not None:
                self._signature = _signature_in(block)  # the wire frame of the one before was lost
                self.dropped[defect] += 1
                continue
            self._signature = None
            if len(block) > 1:
                opened.append(block)
        return b"".join(opened), data[begin:]

    def _verify(self, signature: bytes, frame: bytes) -> Defect | None:
        # The key is worked into the hash once, in __init__; a copy is cheaper than beginning anew.
        keyed = self._keyed.copy()
        keyed.update(signature[:_SIGNED_SIZE] + frame)
        # In constant time: how long it takes must not say how many bytes of a forged tag are right.
        if not hmac.compare_digest(keyed.digest(), signature[_SIGNED_SIZE:]):
            return Defect.BAD_SIGNATURE
        signer, low, high = _SIGNED.unpack_from(signature)
        if (signer == HOST_SIGNER) == self._is_host:
            return Defect.BAD_SIGNATURE  # our own, sent back
        return self._note(signer, high << 32 | low)

    def _note(self, signer: int, count: int) -> Defect | None:
        newest, seen = self._newest.get(signer, (self._floor, 0))
        ahead = count - newest
        # Bit k of seen is the count k before the newest, as in IPsec's window.
        if ahead > 0:
            seen = (seen << ahead | 1) & _WINDOW_MASK if ahead < WINDOW else 1
            self._newest[signer] = count, seen
            self.count = max(self.count, count)
            return None
        # Whether it was taken before cannot be said any more.
        if count <= self._floor or ahead <= -WINDOW:
            self.owes_count = True
            return Defect.OUTDATED
        if seen >> -ahead & 1:
            return Defect.REPLAYED
        self._newest[signer] = newest, seen | 1 << -ahead
        return None


def _signature_in(block: bytes) -> bytes | None:
    """Return the signature that a delimited block holds; None: it is something else."""
    if len(block) != SENT_SIGNATURE_SIZE:
        return None
    raw, place = bytearray(block), 0  # no longer than one block of the stuffing: a shorter way than unstuff
    while place < SIGNATURE_SIZE + 1:
        length = raw[place]
        raw[place] = 0
        place += length
    if place > SIGNATURE_SIZE + 1 or raw[1] != MARK:
        return None
    return bytes(raw[1:-1])
