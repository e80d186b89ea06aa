"""Run a module with the turns of its event loop counted: ``python -m benchmarks.counted_loop MODULE ARGS…``.

A line of standard input is answered by a line of JSON: ``turns``, how often the loop asked the system what
is ready, and ``waits``, how often it slept meanwhile.
"""

from __future__ import annotations

import json
import runpy
import selectors
import sys
import threading
from typing import Any

counts = {"turns": 0, "waits": 0}


def count_turns() -> None:
    """Count the turns of every event loop that is made from now on."""
    select = selectors.DefaultSelector.select

    def counted(self: Any, timeout: float | None = None) -> Any:
        counts["turns"] += 1
        counts["waits"] += timeout is None or timeout > 0
        return select(self, timeout)

    selectors.DefaultSelector.select = counted  # type: ignore[method-assign]


def answer() -> None:
    """Tell the counts for every line that is read."""
    for _ in sys.stdin:
        print(json.dumps(counts), flush=True)


if __name__ == "__main__":
    count_turns()
    threading.Thread(target=answer, daemon=True).start()
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
