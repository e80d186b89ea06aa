"""Golden vectors of signed wire frames: the tag, what is sent, and what must be refused."""

from __future__ import annotations

from hashlib import blake2s
from typing import Any

from firmware_protocol.framing import DELIMITER, PROTOCOL_VERSION, encode_frame
from firmware_protocol.golden_defects import GOOD
from firmware_protocol.messages import SyncRequest
from firmware_protocol.packets import wire_frame
from firmware_protocol.signing import HOST_SIGNER, KEY_SIZE, TAG_SIZE, WINDOW, SignedFrames

KEY = bytes(range(KEY_SIZE))
_MODULE = 0x1234ABCD
_COUNT = 0x0102030405
"""Each vector's receiver takes nothing up to this count."""
_HASHED = (0, 1, 55, 63, 64, 65, 127, 128, 129, 1000)
"""Lengths about the ends of the hash's blocks, bytes."""


def signing_vectors() -> dict[str, Any]:
    """Return what ``vectors/signing.json`` holds."""
    return {
        "protocol_version": PROTOCOL_VERSION,
        "key": KEY.hex(),
        "blake2s": [_hash_vector(bytes(n % 251 for n in range(size))) for size in _HASHED],
        "from_module": [
            _vector(name, sent, SignedFrames(KEY, count=_COUNT)) for name, sent in _from_module().items()
        ],
        "from_host": [
            _vector(name, sent, SignedFrames(KEY, _MODULE, _COUNT)) for name, sent in _from_host().items()
        ],
    }


def _from_module() -> dict[str, bytes]:
    """Return what the host is to take, or to refuse."""
    sent = encode_frame(GOOD)
    first, second, third = (_signed(sent, count) for count in range(1, 4))
    return {
        "a sample": first,
        "the largest count": _signed(sent, 2**48 - 1 - _COUNT),
        "two of one count": third + third,
        "the older one last": third + first,
        "older than the receiver's start": _signed(sent, 0),
        "without a signature": sent + first,
        "a signature without a wire frame": second[: -len(sent)] + first,
        "another key": SignedFrames(bytes(KEY_SIZE), _MODULE, _COUNT).sign(sent) + first,
        "one bit turned": first[:-5] + bytes([first[-5] ^ 2]) + first[-4:],
        "signed by the receiver": SignedFrames(KEY, HOST_SIGNER, _COUNT).sign(sent) + first,
    }


def _from_host() -> dict[str, bytes]:
    """Return what a module is to take, or to refuse."""
    host = SignedFrames(KEY, HOST_SIGNER, _COUNT)
    asked = encode_frame(wire_frame(SyncRequest(7, 1_700_000_000_000_000), 255, 0, 0))
    first, second = host.sign(asked), host.sign(asked)
    far = SignedFrames(KEY, HOST_SIGNER, _COUNT + WINDOW).sign(asked)
    return {
        "a time request": first,
        "the count alone": host.sign(DELIMITER),
        "a request sent twice": first + first,
        "the older one last": second + first,
        "behind the window": far + first,
        "a request without a signature": asked + first,
        "signed by a module": _signed(asked, 1) + second,
    }


def _signed(frame: bytes, ahead: int) -> bytes:
    """Return a frame signed by the module, ``ahead`` counts above what the receiver begins at."""
    return SignedFrames(KEY, _MODULE, _COUNT + ahead - 1).sign(frame)


def _hash_vector(data: bytes) -> dict[str, str]:
    return {"data": data.hex(), "tag": blake2s(data, key=KEY, digest_size=TAG_SIZE).hexdigest()}


def _vector(name: str, sent: bytes, end: SignedFrames) -> dict[str, Any]:
    opened = end.feed(sent)
    dropped = {defect.name: count for defect, count in end.dropped.items()}
    return {
        "name": name,
        "signer": end.signer,
        "count": _COUNT,
        "input": sent.hex(),
        "opened": opened.hex(),
        "dropped": dropped,
        "count_after": end.count,
        "owes_count": end.owes_count,
    }
