"""Files that are written for the user: whole or not at all, and with a line where they cannot be."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from gateway.errors import GatewayError

_REMEDIES: dict[int | None, str] = {
    errno.ENOENT: "name a place that exists, or make the folder first",
    errno.ENOTDIR: "a part of the path is a file: name another place",
    errno.EISDIR: "that is a folder: name a file in it",
    errno.EEXIST: "something lies there already: name another place",
    errno.EINVAL: "that is no file, or no name for one: name another place",
    errno.ENAMETOOLONG: "the name is too long: name another place",
    errno.EACCES: "you may not write there: name another place, or change its permissions",
    errno.EPERM: "you may not write there: name another place, or change its permissions",
    errno.EROFS: "that disk cannot be written: name another place",
    errno.ENOSPC: "the disk is full: make room, or name another place",
    errno.EFBIG: "no file of that size may lie there, as on a FAT disk or by a limit: name another place",
    errno.EIO: "the disk reports an error: name another place, and check that disk",
    errno.EDQUOT: "your share of the disk is used up: make room, or name another place",
}


def free_bytes(folder: Path) -> int:
    """Return the room on the disk that a folder is on, as an ordinary user has it. Raises ``OSError``."""
    return shutil.disk_usage(folder).free


def remedy_of(error: OSError) -> str | None:
    """Return what to do about a file that cannot be used; None where that is not known."""
    return _REMEDIES.get(error.errno)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise ``GatewayError``, which names ``path``, for an ``OSError`` in what writes it."""
    try:
        yield
    except OSError as error:
        remedy = remedy_of(error)
        what_to_do = "" if remedy is None else f": {remedy}"
        raise GatewayError(f"{path} cannot be written: {error.strerror}{what_to_do}") from error


def write_whole(path: Path, content: bytes, mode: int | None = None) -> None:
    """Write a file so that nobody ever sees a part of it; one that is there is replaced.

    mode: permissions, such as 0o600 for a secret; none: those of the file that is there, or the usual ones.
    Raises ``OSError``, such as for a full disk; then all is as it was before.
    """
    with replacing(path, mode) as made:
        made.write_bytes(content)


@contextlib.contextmanager
def replacing(path: Path, mode: int | None = None) -> Iterator[Path]:
    """Give an empty file to write, which takes the place of ``path`` in the end; after an error it is gone,
    and all is as it was before. mode: as in ``write_whole``. An ``OSError`` names ``path``."""
    path = _replaceable(path)
    if mode is None:
        mode = path.stat().st_mode if path.exists() else 0o666 & ~_umask()
    prefix, made = f".{path.name}.", None
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=prefix)
        made = Path(name)
        try:
            yield made
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        made.chmod(mode & 0o7777)
        made.replace(path)
    except BaseException as error:
        if made is not None:
            made.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None:
            named = [str(name) for name in (error.filename, error.filename2) if name is not None]
            if not named or any(prefix in name for name in named):
                raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
        raise


@contextlib.contextmanager
def replacing_by_name(path: Path) -> Iterator[Path]:
    """Give a path of the same name in a folder of its own, for files that hold their name; what is written
    there takes the place of ``path`` in the end, or is gone after an error."""
    path = _replaceable(path)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        made = Path(folder, path.name)
        yield made
        made.replace(path)


def _replaceable(path: Path) -> Path:
    """Return what a link stands for: that is replaced, not the link. Raises ``OSError`` for a device."""
    path = path.resolve()
    if path.exists() and not path.is_file():
        code = errno.EISDIR if path.is_dir() else errno.EINVAL
        raise OSError(code, "it is no file", str(path))
    return path


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
