"""The terminal: its width, a progress bar, and lines that are typed."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import threading
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

_NARROWEST = 170


def wide_console(narrowest: int = 0) -> Console:
    """Return the terminal; what is not one gets room for whole tables.

    narrowest: columns that lines have at least; the terminal breaks them where it has fewer.
    """
    console = Console()
    width = console.width if console.is_terminal else _NARROWEST
    return Console(width=max(width, narrowest))


@contextlib.contextmanager
def progress_bar(what: str, *, is_shown: bool = True) -> Iterator[Callable[[int, int], None]]:
    """Show a bar on standard error, gone at the end: ``with progress_bar("reading") as progress:
    progress(done, total)``."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not is_shown) as progress:
        task = progress.add_task(what, total=None)

        def report(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        yield report


class TypedLines:
    """Standard input, line by line, whatever it is: terminal, pipe or file. Belongs to one event loop."""

    def __init__(self) -> None:
        self._lines: asyncio.Queue[str | None] = asyncio.Queue()
        self._loop = asyncio.get_running_loop()
        self.has_ended = False
        # A thread: readiness of standard input cannot be watched where it is a file, and a read that
        # waits cannot be cancelled. As a daemon it does not keep the program from ending.
        threading.Thread(target=self._read, name="typed lines", daemon=True).start()

    async def next(self) -> str | None:
        """Return the next line, stripped; None, from then on, at the end of the input."""
        if self.has_ended:
            return None
        line = await self._lines.get()
        self.has_ended = line is None
        return line

    def typed(self) -> str | None:
        """Return the next line if there is one already; None: nothing was typed, or the input has ended."""
        if self._lines.empty():
            return None
        line = self._lines.get_nowait()
        self.has_ended = line is None
        return line

    def _read(self) -> None:
        # No terminal to be read, as in the background, is the end of the input.
        with contextlib.suppress(OSError):
            for line in sys.stdin or ():
                self._put(line.strip().lower())
        self._put(None)

    def _put(self, line: str | None) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._lines.put_nowait, line)
