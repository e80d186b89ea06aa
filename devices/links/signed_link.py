"""A link whose wire frames are signed in both directions, and the file that its key is in."""

from __future__ import annotations

import logging
import os
import secrets
import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace
from pathlib import Path

from devices.link import Chunk, LinkError, LiveLink
from devices.links.link_counts import LinkCounts
from firmware_protocol import DELIMITER, Defect
from firmware_protocol.signing import KEY_SIZE, SignedFrames

_log = logging.getLogger(__name__)

_COUNT_STEP_NS = 16_000
"""Counts begin at the time in these steps: no link carries 62 500 wire frames a second, so a count is never
ahead of the time, and what was signed before the start is below it. 48 bits last to the year 2112."""
_NOT_FOR_OTHERS = 0o027


def time_count() -> int:
    """Return what a count begins at where there is a clock."""
    return time.time_ns() // _COUNT_STEP_NS


def read_key(path: Path) -> bytes:
    """Return the key in a file: its first line, 64 hexadecimal digits.

    Raises ValueError, naming the file and never its content: it cannot be read, others may read or the group
    may change it, or it is no key.
    """
    try:
        with path.open("rb") as opened:
            mode = os.fstat(opened.fileno()).st_mode
            line = opened.readline(2 * KEY_SIZE + 2)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    # Asked of the open file, not of the path: between two looks somebody could put another file there.
    if mode & _NOT_FOR_OTHERS:
        raise ValueError(f"{path} is open to others: chmod 600 {path}")
    try:
        key = bytes.fromhex(line.decode("ascii"))
    except ValueError:
        key = b""
    if len(key) != KEY_SIZE:
        raise ValueError(
            f"{path} does not begin with a key of {2 * KEY_SIZE} hexadecimal digits: "
            "mocap-gateway config key FILE makes one"
        )
    return key


def write_key(path: Path) -> None:
    """Make a key and put it into a new file that nobody else may read. Raises OSError, also where one is."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as opened:
        opened.write(secrets.token_hex(KEY_SIZE) + "\n")


class SignedLink:
    """Signs what is written to a link, and hands on what is rightly signed, without its signatures.

    All else is dropped and counted before anybody looks at it: what reads and records the link sees the
    bytes of an unsigned one. Where chunks name their senders, a chunk holds whole wire frames.
    """

    def __init__(self, link: LiveLink, key: bytes) -> None:
        """Sign what is written to ``link``, and accept only what is signed from now on, by this clock."""
        self.link = link
        self.name = link.name
        self.framing = link.framing
        self._frames = SignedFrames(key, count=time_count())
        self._reported: set[Defect] = set()
        self.counts.unverified = self._frames.dropped

    @property
    def counts(self) -> LinkCounts:
        """Those of the link itself, and what its signatures cost."""
        counts = getattr(self.link, "counts", None)
        return counts if isinstance(counts, LinkCounts) else LinkCounts()

    async def open(self) -> None:
        """Open the link; counts go on where they were."""
        await self.link.open()
        self._frames.restart()

    async def __aiter__(self) -> AsyncIterator[Chunk]:
        async for chunk in self.link:
            # A datagram is complete; a stream's chunk may end within a frame.
            read = self._frames.open if chunk.sender else self._frames.feed
            dropped = self._frames.dropped.total()
            data = read(chunk.data)
            if self._frames.dropped.total() != dropped:
                self._warn_once(chunk.sender)
            if self._frames.owes_count:
                await self._give_count(chunk.sender)
            if data:
                yield replace(chunk, data=data)

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Sign whole wire frames and send them. Raises ``LinkError``, also when the key is used up."""
        try:
            signed = self._frames.sign(data)
        except OverflowError:
            raise LinkError(f"{self.name}: the key has been used up: make another one") from None
        await self.link.write(signed, to)

    async def close(self) -> None:
        """Close the link."""
        await self.link.close()

    async def _give_count(self, sender: str) -> None:
        """Answer a device that has the key and not the count, with fewer bytes than came."""
        try:
            await self.write(DELIMITER, (sender,) if sender else ())
        except LinkError as error:
            _log.debug("%s: no count given: %s", self.name, error)

    def _warn_once(self, sender: str) -> None:
        """Warn once of each reason; who has no count yet is no reason to worry."""
        for defect in self._frames.dropped.keys() - self._reported - {Defect.OUTDATED}:
            self._reported.add(defect)
            _log.warning("%s: dropped, from %s: %s", self.name, sender or "the other end", defect.value)
