"""``mocap-gateway calibrate clocks``: measure the table of clock compensations."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from devices.endpoints import link_from_url
from devices.link import Link, gateway_time_ns
from devices.link_decoder import LinkDecoder
from devices.reconnect import ReconnectingLink
from devices.replay_link import ReplayLink, carried_links
from gateway.body.rig import load_rig
from gateway.clocks import ClockCalibration, ClockTable, LinkBatching, save_clock_table, warm_up
from gateway.clocks.table import MINUTE_S
from gateway.errors import GatewayError
from gateway.settings import GatewaySettings, load_gateway_settings

_UNHEARD_S = 10.0


def clocks(
    config: Annotated[
        Path, typer.Option("--config", "-c", help="Configuration file: its links and rig.")
    ] = Path("config/gateway.yaml"),
    minutes: Annotated[int, typer.Option(min=1, max=240, help="Minutes in the table: k = 1 to this.")] = 60,
    repetitions: Annotated[int, typer.Option(min=1, max=100, help="Measure so often, and average.")] = 1,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="File to write [<rig>.clocks.yaml beside the config]"),
    ] = None,
    minute_s: Annotated[float, typer.Option(min=0.5, max=60, hidden=True)] = MINUTE_S,
    settling_s: Annotated[float, typer.Option(min=0, hidden=True)] = 15.0,
) -> None:
    """Rank the modules by their crystals and measure their rates against the slowest one's, minute by minute.

    Switch all modules of the rig on, let them lie as warm as they will be worn, and wait. The table is then
    used by `clock: {mode: table, table: <file>}`.
    """
    settings = load_gateway_settings(config)
    suit = load_rig(settings.rig, config)
    target = output or config.parent / f"{Path(settings.rig).stem}.clocks.yaml"
    if not target.parent.is_dir():
        raise GatewayError(f"{target}: there is no folder {target.parent} to write it to")
    warm_up()
    calibration = ClockCalibration(suit.module_ids, minutes, repetitions, minute_s, settling_s)
    with contextlib.suppress(asyncio.CancelledError):
        asyncio.run(_measure(settings, calibration))
    table = calibration.table()
    save_clock_table(table, target)
    console = Console()
    console.print(_as_table(table))
    console.print(f"written to {target}", soft_wrap=True)


async def _measure(settings: GatewaySettings, calibration: ClockCalibration) -> None:
    """Listen on all links until the calibration has had its time, or until every link has come to its end."""
    links = [
        link_from_url(link.url, name=link.name) for link in settings.links if link.carries != "heat_maps"
    ]
    tasks = [
        asyncio.create_task(
            _listen(link if isinstance(link, ReplayLink) else ReconnectingLink(link), calibration)
        )
        for link in links
    ]
    begin_ns = gateway_time_ns()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    try:
        with Progress(*columns, transient=True) as progress:
            bar = progress.add_task("measuring clocks", total=calibration.duration_s)
            while not calibration.is_complete and not all(task.done() for task in tasks):
                await asyncio.wait(tasks, timeout=0.2, return_when=asyncio.ALL_COMPLETED)
                progress.update(bar, completed=calibration.elapsed_s)
                if not calibration.heard and gateway_time_ns() - begin_ns > _UNHEARD_S * 1e9:
                    raise GatewayError(
                        f"no module of the rig was heard for {_UNHEARD_S:.0f} s: are they switched on, "
                        "and is the link right?"
                    )
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result


async def _listen(link: Link, calibration: ClockCalibration) -> None:
    await link.open()
    decoders = {name: LinkDecoder(framing) for name, framing in carried_links(link).items()}
    batchings = {name: LinkBatching() for name in decoders}
    try:
        async for chunk in link:
            batching, decoder = batchings[chunk.link], decoders[chunk.link]
            packets = decoder.feed(chunk)
            if decoder.is_trusted:
                batching.observe(chunk.arrived_ns)
            for packet in packets:
                calibration.observe(packet.module, packet.module_time_us, chunk.arrived_ns, batching)
            if calibration.is_complete:
                break
    finally:
        await link.close()


def _as_table(table: ClockTable) -> Table:
    shown = Table("rank", "module", "ppm against the slowest", "α of the first minute", "α of the last")
    for rank, module in enumerate(table.ranking, start=1):
        alpha = table.alpha[module]
        shown.add_row(
            str(rank), str(module), f"{table.skew_ppm(module):+.2f}", f"{alpha[0]:.9f}", f"{alpha[-1]:.9f}"
        )
    return shown
