"""A key that is typed while modules are asked counts, whatever comes of the asking."""

from __future__ import annotations

import asyncio
import io
import sys

from rich.console import Console

from gateway.cli.modules import _Fitting
from gateway.modules.operations import RequestError

SEGMENTS = {"link_1": 0, "link_2": 1}


class Operations:
    """Modules that nobody moves; the first look for one fails."""

    def __init__(self) -> None:
        self.looks = 0

    async def perform(self, verb, request):
        await asyncio.sleep(0.01)
        if verb == "list":
            modules = [{"module": n, "unique_id": f"{n:032x}", "answers": True} for n in SEGMENTS.values()]
            told = {"allows_writes": True, "assigns": True, "conflicts": []}
            return told | {"modules": modules, "segments": SEGMENTS}
        assert verb == "motion"
        self.looks += 1
        if self.looks == 2:  # the first one learns what is usual
            raise RequestError("no answer in time")
        return {"module": None}


async def test_a_key_survives_a_look_that_fails(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO("nonsense\ns\nq\n"))
    console = Console(file=io.StringIO(), width=200)
    operations = Operations()
    fitting = _Fitting(operations, console, is_sure=True, timeout=None)
    await fitting.begin(None)
    assert await fitting.assign_all() == 1
    said = console.file.getvalue()
    assert "not assigned: link_1, link_2" in said
    assert said.count("keys, each with Enter") == 2  # at the beginning, and for the nonsense
    assert operations.looks >= 2
