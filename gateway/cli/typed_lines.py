"""Lines that the user types, for a program that waits for something else too."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import threading


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
        """The next line, stripped; None, from then on, at the end of the input."""
        if self.has_ended:
            return None
        line = await self._lines.get()
        self.has_ended = line is None
        return line

    def typed(self) -> str | None:
        """The next line if there is one already; None: nothing has been typed, or no more."""
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
