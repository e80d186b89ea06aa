"""A lock that processes share by a file: freed by the system when its holder ends, however it ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

_INTERVAL_S = 0.01


@contextlib.contextmanager
def file_lock(path: Path, patience_s: float = 0.0, note: str = "") -> Iterator[None]:
    """Hold the lock of a file, which is made where there is none and stays.

    patience_s: how long another holder is waited for. note: written into the file where that can be done, for
    those who are refused.
    Raises ``BlockingIOError`` when somebody else holds it, ``OSError`` for a file that cannot be used.
    """
    lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        _take(lock, time.monotonic() + patience_s)
        if note:
            with contextlib.suppress(OSError):  # a disk may be full, and this be what makes room
                os.ftruncate(lock, 0)
                os.write(lock, note.encode())
        yield
    finally:
        os.close(lock)


def _take(lock: int, end_s: float) -> None:
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end_s:
                raise
            time.sleep(_INTERVAL_S)
        else:
            return
