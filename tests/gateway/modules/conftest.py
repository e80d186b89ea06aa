"""An emulated suit whose modules are listed and changed in the test's event loop."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from devices.commands.command_client import CommandClient
from gateway.body.rig import load_rig
from gateway.modules.journal import Journal
from gateway.modules.operations import ModuleOperations
from gateway.modules.session import connect_client
from gateway.sources.suit import SuitSource


@pytest.fixture
def operated(commanded_suit, tmp_path, monkeypatch):
    """``async with operated(stored_ids=...) as (suit, operations, journal)``."""
    # A few modules without a relay answer within 10 ms, unless the machine is busy.
    monkeypatch.setattr("devices.commands.transactions.BROADCAST_WAITS_S", (0.15, 0.25, 0.4))

    @contextlib.asynccontextmanager
    async def start(allow_writes=True, **settings):
        journal = Journal(tmp_path / "module_changes.json")
        async with commanded_suit(**settings) as suit:
            stream = SuitSource()
            client = CommandClient([suit.link], allow_writes=allow_writes)
            connect_client(client, stream)
            stream.add_link(suit.link.name, suit.link.framing)
            operations = ModuleOperations(stream, client, load_rig("robot_arm_4"), journal)
            await suit.link.open()
            reading = asyncio.create_task(_read(suit.link, stream))
            try:
                yield suit, operations, journal
            finally:
                reading.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await reading

    async def _read(link, stream):
        async for chunk in link:
            stream.receive(chunk)

    return start
