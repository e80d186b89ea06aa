"""``compare --live``: two running gateways, compared every second over the last ones."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass

import typer
from rich.console import Console, Group
from rich.live import Live as LiveTable
from rich.table import Table
from rich.text import Text

from gateway.agreement import Agreement, agreement
from gateway.agreement.live import PoseWindow, comparison_message
from gateway.agreement.time_alignment import SHORTEST_OVERLAP_S
from gateway.cli.compare import HEADS, notes, rows
from gateway.contract.messages import ComparisonMessage
from gateway.contract.topics import Topics
from gateway.errors import GatewayError
from gateway.outputs.connection import broker_connection, explain, unique_identifier
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import BrokerUnreachableError, PoseSubscriber

_EVERY_S = 1.0


@dataclass(frozen=True)
class Live:
    """What to compare, and until when."""

    first: str
    second: str
    renamed: Mapping[str, str]
    largest_lag_s: float | None
    window_s: float
    count: int | None
    as_json: bool
    own_headings: bool = False


def run_live(settings: MqttSettings, wanted: Live) -> int:
    """The exit code: 0 on Ctrl-C or when all is done, 1 with one line when the broker cannot be used."""
    try:
        topics = [Topics(settings.base_topic, name) for name in (wanted.first, wanted.second)]
        asyncio.run(_compare(settings, wanted, topics[0]))
    except KeyboardInterrupt:
        return 0
    except (BrokerUnreachableError, ValueError) as error:
        typer.echo(str(error), err=True)
        return 1
    return 0


async def _compare(settings: MqttSettings, wanted: Live, topics: Topics) -> None:
    windows = {name: PoseWindow(wanted.window_s) for name in (wanted.first, wanted.second)}
    async with PoseSubscriber(settings) as poses:
        collecting = asyncio.create_task(_collect(poses, windows))
        try:
            await _say(settings, wanted, topics, poses, windows)
        finally:
            collecting.cancel()


async def _collect(poses: PoseSubscriber, windows: Mapping[str, PoseWindow]) -> None:
    async for received in poses:
        if received.gateway in windows:
            windows[received.gateway].add(received.pose)


async def _say(
    settings: MqttSettings,
    wanted: Live,
    topics: Topics,
    poses: PoseSubscriber,
    windows: Mapping[str, PoseWindow],
) -> None:
    said, console = 0, Console()
    with LiveTable(console=console, auto_refresh=False, screen=False) as table:
        while wanted.count is None or said < wanted.count:
            await asyncio.sleep(_EVERY_S)
            found = await _found(wanted, poses, windows)
            if isinstance(found, str):
                _show(table, wanted, Text(found, "yellow"))
                continue
            said += 1
            message = comparison_message(
                found, windows[wanted.first].newest_ns, wanted.second, wanted.window_s
            )
            problem = await _publish(settings, topics, message)
            if wanted.as_json:
                typer.echo(message.payload().decode())
            else:
                _show(table, wanted, Group(Text("\n".join([*notes(found), *problem])), _table(found)))


async def _found(wanted: Live, poses: PoseSubscriber, windows: Mapping[str, PoseWindow]) -> Agreement | str:
    """The agreement over the window, or why there is none."""
    for name, window in windows.items():
        if name not in poses.bodies or window.duration_s < SHORTEST_OVERLAP_S:
            return f"waiting for poses of gateway '{name}' ({poses.states.get(name, 'not heard of')})"
    origin_ns = windows[wanted.first].newest_ns
    first, second = (windows[name].tracks(poses.bodies[name], origin_ns) for name in windows)
    try:
        return await asyncio.to_thread(
            agreement,
            first,
            second,
            wanted.renamed,
            wanted.largest_lag_s,
            own_headings=wanted.own_headings,
        )
    except GatewayError as error:
        return str(error)


async def _publish(settings: MqttSettings, topics: Topics, message: ComparisonMessage) -> list[str]:
    """What went wrong, if anything: a broker that refuses does not end the comparison."""
    try:
        async with broker_connection(settings, settings.port, unique_identifier("compare")) as client:
            await client.publish(topics.comparison, message.payload())
    except Exception as error:  # explain() has words for all that a connection may raise
        return [f"not published: {explain(error, settings, settings.port)}"]
    return []


def _show(table: LiveTable, wanted: Live, content: Text | Group) -> None:
    if not wanted.as_json:
        table.update(content, refresh=True)
    elif isinstance(content, Text):
        typer.echo(content.plain, err=True)


def _table(found: Agreement) -> Table:
    table = Table(*HEADS)
    for row in rows(found):
        table.add_row(*row)
    return table
