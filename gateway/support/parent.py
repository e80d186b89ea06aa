"""Processes that end with the one that started them, however that ends."""

from __future__ import annotations

import os
import signal
import threading
import time

_LOOK_S = 0.5


def end_with_parent(parent: int | None = None) -> None:
    """Have this process end (SIGTERM) once the one that started it is gone: where that was killed, nobody
    else would end it. parent: number of that process, for one that may be gone already.
    """
    expected = os.getppid() if parent is None else parent

    def watch() -> None:
        while os.getppid() == expected:
            time.sleep(_LOOK_S)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="parent", daemon=True).start()
