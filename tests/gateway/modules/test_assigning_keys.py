"""A key that is typed while modules are asked counts, whatever comes of the asking."""

from __future__ import annotations

import asyncio
import io
import sys

import pytest
from rich.console import Console

from gateway.cli.modules import _Fitting
from gateway.errors import GatewayError
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


class OneIsLate:
    """Two modules, of which the second is heard among all from a certain list on."""

    def __init__(self, heard_from: int) -> None:
        self.heard_from = heard_from
        self.lists = 0

    async def perform(self, verb, request):
        if verb == "read":
            return {"unique_id": request["device"]}
        if verb == "assign":
            return {"changes": []}
        assert verb == "list"
        self.lists += 1
        there = [0, 1] if self.lists >= self.heard_from else [0]
        modules = [{"module": n, "unique_id": f"{n:024x}", "answers": True} for n in there]
        told = {"allows_writes": True, "assigns": True, "conflicts": []}
        return told | {"modules": modules, "segments": SEGMENTS}


async def assigned_by_name(operations) -> str:
    console = Console(file=io.StringIO(), width=200)
    fitting = _Fitting(operations, console, is_sure=True, timeout=None)
    await fitting.begin(["link_1"])
    await fitting.assign_named(f"{1:024x}")
    return console.file.getvalue()


async def test_a_named_module_that_was_heard_late_is_looked_for_again():
    assert "is module 0 now" in await assigned_by_name(OneIsLate(heard_from=2))


async def test_a_named_module_that_is_never_heard_among_all_is_told():
    with pytest.raises(GatewayError, match="was not heard among all"):
        await assigned_by_name(OneIsLate(heard_from=99))
