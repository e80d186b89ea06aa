"""Files that are written for the user: whole or not at all, and with a line where they cannot be."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from gateway.errors import GatewayError


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Around what writes a file or folder: raise ``GatewayError``, which names it, for an ``OSError``."""
    try:
        yield
    except OSError as error:
        raise GatewayError(f"{path} cannot be written: {error.strerror}") from error


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that nobody ever sees a part of it; one that is there is replaced.

    Raises ``OSError``, such as for a full disk; then all is as it was before.
    """
    path = path.resolve()  # what a link stands for is replaced, not the link
    mode = path.stat().st_mode if path.exists() else 0o666 & ~_umask()
    descriptor, made = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(made, mode & 0o7777)
        Path(made).replace(path)
    except BaseException:
        Path(made).unlink(missing_ok=True)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
