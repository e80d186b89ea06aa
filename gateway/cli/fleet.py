"""``mocap-gateway fleet``: many gateways at once."""

from __future__ import annotations

import asyncio
import contextlib
import csv
import json
import secrets
import signal
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Coroutine
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.live import Live
from rich.table import Table

from gateway.cli.options import AsJson, BrokerChoice, with_broker
from gateway.cli.terminal import wide_console
from gateway.errors import GatewayError
from gateway.outputs.settings import MqttSettings
from gateway.support.credentials import AccessToken, token_for
from gateway.support.names import printable

if TYPE_CHECKING:
    from gateway.fleet.collecting import Collector
    from gateway.fleet.demonstration import DemoFleet
    from gateway.fleet.overview import Fleet, OverviewRow

fleet_app = typer.Typer(
    help="Many gateways: brokers to try, an overview of all, an archive of what they sent.",
    epilog="Examples: mocap-gateway fleet list --host broker1; "
    "mocap-gateway fleet archive list --archive clinic",
    no_args_is_help=True,
    add_completion=False,
)

LOOPBACK = "127.0.0.1"
TOKEN_VARIABLE = "MOCAP_PAGE_TOKEN"
_REFRESH_S = 0.5
_LOOK_S = 1.0
"""Between two looks whether what was collected is to be written."""
_AFTER_TROUBLE_S = 10.0
_LAST_FLUSH_S = 600.0
"""Longest wait for another command that changes the archive, before what was collected is given up."""

Wearers = Annotated[
    Path | None, typer.Option(help="YAML file that names the wearer of each gateway: {gw001: anna, …}.")
]
PagePort = Annotated[int | None, typer.Option(min=1, max=65535, help="Serve the overview as a page, too.")]
PageHost = Annotated[
    str, typer.Option(help="Address that the page listens on; elsewhere than here it needs a token.")
]
TokenFile = Annotated[
    Path | None, typer.Option(help="File with the token that opens the page; else MOCAP_PAGE_TOKEN is taken.")
]


@fleet_app.command("list", epilog="Example: mocap-gateway fleet list --host broker1 --failover broker2:1883")
@with_broker
def list_gateways(
    broker: BrokerChoice,
    wearers: Wearers = None,
    seconds: Annotated[
        float, typer.Option(min=1, max=600, help="How long rates and losses are measured.")
    ] = 5,
    as_json: AsJson = False,
) -> None:
    """Show every gateway once: wearer, state, rate, loss, delay, disk, versions. Ends with 1 on an alert."""
    rows = asyncio.run(_measured(broker.settings(), read_wearers(wearers), seconds))
    if as_json:
        from gateway.fleet.overview import as_plain

        typer.echo(json.dumps(as_plain(rows)))
    else:
        wide_console().print(table_of(rows))
    if not rows:
        raise GatewayError("no gateway was heard: do they publish at this broker, below this base topic?")
    if any(row.alerts for row in rows):
        raise typer.Exit(1)


@fleet_app.command(epilog="Example: mocap-gateway fleet watch --host broker1 --page-port 8090")
@with_broker
def watch(
    broker: BrokerChoice,
    wearers: Wearers = None,
    page_port: PagePort = None,
    page_host: PageHost = LOOPBACK,
    token_file: TokenFile = None,
) -> None:
    """Show every gateway, renewed twice a second, in the terminal and on a page with links to the bodies."""
    settings, names = broker.settings(), read_wearers(wearers)
    _end_on_sigterm()
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_watch(settings, names, page_port, page_host, token_file))


@fleet_app.command(epilog="Example: mocap-gateway fleet demo --gateways 20 --seconds 60")
def demo(
    gateways: Annotated[int, typer.Option(min=1, max=200, help="Light gateways.")] = 20,
    rate: Annotated[float, typer.Option(min=1, max=100, help="Poses a second of each.")] = 20,
    recording: Annotated[
        Path | None, typer.Option(help="A recording whose poses they publish; else a simulated person's.")
    ] = None,
    page_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the overview's page.")] = 8090,
    seconds: Annotated[
        float | None, typer.Option(min=1, help="End after so long; else it runs until Ctrl-C.")
    ] = None,
) -> None:
    """Start three brokers, light gateways and the overview on this machine. Needs the extra `fleet`."""
    _end_on_sigterm()
    with contextlib.suppress(KeyboardInterrupt):
        _demonstrate(gateways, rate, recording, page_port, seconds)


@fleet_app.command(epilog="Example: mocap-gateway fleet users gw001 gw002 -o docker/fleet")
def users(
    gateways: Annotated[list[str], typer.Argument(help="Names of the gateways.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the brokers' configuration.")],
    site: Annotated[
        list[str] | None, typer.Option(help="A site with a node of its own, which gets a user; repeatable.")
    ] = None,
    base_topic: Annotated[str, typer.Option(help="First part of the topics.")] = "mocap",
) -> None:
    """Write the users of a NATS cluster: each gateway may publish its own topics and nobody else's.

    users.conf is for the brokers, passwords/NAME for the gateway of that name (mqtt.password_file). User
    overview is for `fleet watch`. Users that have a password keep it.
    """
    from gateway.fleet.cluster import write_users

    names = write_users(output, gateways, base_topic, site or ())
    typer.echo(f"{output / 'users.conf'}: {len(names)} users, passwords in {output / 'passwords'}")


@fleet_app.command(
    epilog="Example: mocap-gateway fleet configure gw001 gw002 --set recording.rotate_minutes=30 --apply"
)
@with_broker
def configure(
    broker: BrokerChoice,
    gateways: Annotated[list[str], typer.Argument(help="Names of the gateways.")],
    given: Annotated[
        list[str],
        typer.Option("--set", metavar="NAME=VALUE", help="A setting; null: as the gateway's file says."),
    ],
    apply: Annotated[
        bool, typer.Option("--apply", help="Take them into use; else the differences are shown alone.")
    ] = False,
    within: Annotated[
        float, typer.Option(min=5, max=600, help="A gateway that is not back after so long goes back, s.")
    ] = 60,
) -> None:
    """Push settings to gateways whose configuration allows it (allow_configuration).

    Shows what would change. With --apply one gateway after another takes them into use, and is asked whether
    it is back and publishes; the first that is not ends the command, and goes back by itself.
    """
    from gateway.fleet.configuring import differences, push, settings_of

    settings, wanted = broker.settings(), settings_of(given)
    for name in gateways:
        for each in asyncio.run(differences(settings, name, wanted)):
            values = json.dumps(each["before"]), json.dumps(each["after"])
            typer.echo(printable(f"{name}: {each['setting']}: {values[0]} → {values[1]}"))
    if not apply:
        typer.echo("nothing was changed: --apply does it")
        return
    for name in gateways:
        is_changed = asyncio.run(push(settings, name, wanted, within))
        typer.echo(f"{name}: {'taken into use and confirmed' if is_changed else 'as it was'}")


def _end_on_sigterm() -> None:
    """Have SIGTERM end the command as Ctrl-C does: with all processes that it has started."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def _demonstrate(
    gateways: int, rate: float, recording: Path | None, page_port: int, seconds: float | None
) -> None:
    from gateway.fleet.demonstration import DemoFleet, DemonstrationPlan

    recording = None if recording is None else recording.resolve(strict=True)
    with (
        tempfile.TemporaryDirectory(prefix="mocap_fleet_") as folder,
        DemoFleet(Path(folder), DemonstrationPlan(gateways, rate, recording)) as fleet,
    ):
        typer.echo(f"three brokers at {', '.join(fleet.cluster.addresses())}; {gateways} light gateways")
        wearers = {name: f"wearer {number}" for number, name in enumerate(fleet.names, 1)}
        watching = _watch(fleet.settings(), wearers, page_port, LOOPBACK, None)
        asyncio.run(_for_a_while(_while_all_run(fleet, watching), seconds))


async def _while_all_run(fleet: DemoFleet, watching: Coroutine[Any, Any, None]) -> None:
    """Watch, and raise ``GatewayError`` when light gateways end by themselves."""
    from gateway.outputs.connection import first_to_end

    async def look() -> None:
        while True:
            if (trouble := fleet.trouble()) is not None:
                raise GatewayError(f"light gateways ended by themselves: {trouble}")
            await asyncio.sleep(_LOOK_S)

    await first_to_end(watching, look())


async def _for_a_while(watching: object, seconds: float | None) -> None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await watching  # type: ignore[misc]


def read_wearers(path: Path | None) -> dict[str, str]:
    """Return the wearer of each gateway by a YAML file. Raises ``GatewayError`` for one that is none."""
    if path is None:
        return {}
    from gateway.support.settings_files import load_yaml

    loaded = load_yaml(path)
    if not isinstance(loaded, dict):
        raise GatewayError(f"{path}: a wearer's name by gateway is wanted, such as gw001: anna")
    for gateway, name in loaded.items():
        if not isinstance(gateway, str) or not isinstance(name, str) or not name.strip():
            raise GatewayError(
                f"{path}: {gateway!r}: {name!r}: a wearer's name by gateway is wanted, in quotes where it "
                "looks like a number or a date"
            )
    return loaded


@contextlib.asynccontextmanager
async def _listening(settings: MqttSettings, wearers: dict[str, str]) -> AsyncIterator[Fleet]:
    from gateway.fleet.overview import Fleet, listener, take_into
    from gateway.outputs.connection import end_tasks

    fleet = Fleet(settings.base_topic, wearers)
    receiver = listener(settings, take_into(fleet))
    listening = asyncio.create_task(receiver.run())
    waiting = asyncio.create_task(receiver.subscribed.wait())
    try:
        await asyncio.wait({listening, waiting}, return_when=asyncio.FIRST_COMPLETED)
        if listening.done():
            listening.result()
        yield fleet
    finally:
        if receiver.dropped:
            typer.echo(f"{receiver.dropped} messages came faster than they could be counted", err=True)
        waiting.cancel()
        await end_tasks(listening)


async def _measured(settings: MqttSettings, wearers: dict[str, str], seconds: float) -> list[OverviewRow]:
    async with _listening(settings, wearers) as fleet:
        await asyncio.sleep(seconds)
        return fleet.rows(time.monotonic())


async def _watch(
    settings: MqttSettings,
    wearers: dict[str, str],
    page_port: int | None,
    page_host: str,
    token_file: Path | None,
) -> None:
    console = wide_console()
    async with contextlib.AsyncExitStack() as stack:
        fleet = await stack.enter_async_context(_listening(settings, wearers))
        if page_port is not None:
            await stack.enter_async_context(_page(settings, fleet, page_host, page_port, token_file))
        if not console.is_terminal:
            await _lines(fleet)
        live = stack.enter_context(Live(console=console, auto_refresh=False))
        while True:
            live.update(table_of(fleet.rows(time.monotonic())), refresh=True)
            await asyncio.sleep(_REFRESH_S)


async def _lines(fleet: Fleet) -> None:
    """Print a line now and then, where nobody looks at a table."""
    while True:
        await asyncio.sleep(5)
        rows = fleet.rows(time.monotonic())
        online = sum(row.state == "online" for row in rows)
        rate = sum(row.rate_hz for row in rows)
        alerts = [f"{row.gateway}: {'; '.join(row.alerts)}" for row in rows if row.alerts]
        typer.echo(
            f"{len(rows)} gateways, {online} online, {rate:.0f} poses/s, "
            f"{sum(row.lost for row in rows)} lost, {len(alerts)} with alerts"
        )
        for alert in alerts[:10]:
            typer.echo(f"  {printable(alert)}")


@contextlib.asynccontextmanager
async def _page(
    settings: MqttSettings, fleet: Fleet, host: str, port: int, token_file: Path | None
) -> AsyncIterator[None]:
    from gateway.fleet.overview import as_plain
    from gateway.fleet.page import Bodies, OverviewServer
    from gateway.viewer.gate import Door, Gate

    token = token_for("the page", host, token_file, TOKEN_VARIABLE, "--token-file")
    gate_pass = AccessToken(secrets.token_urlsafe(32))
    server = OverviewServer(lambda: as_plain(fleet.rows(time.monotonic())), Bodies(settings), gate_pass)
    async with server, Gate(host, port, server.port, Door(token), gate_pass=gate_pass):
        typer.echo(f"overview: http://{host}:{port}{'/?token=…' if token is not None else ''}")
        yield


def table_of(rows: list[OverviewRow]) -> Table:
    """Return the overview for the terminal."""
    bad = sum(bool(row.alerts) for row in rows)
    online = sum(row.state == "online" for row in rows)
    table = Table(title=f"{len(rows)} gateways, {online} online, {bad} with alerts", title_justify="left")
    for name in ("gateway", "wearer", "state"):
        table.add_column(name)
    for name in ("poses/s", "loss", "delay ms", "lost", "late", "free GB"):
        table.add_column(name, justify="right")
    for name in ("version", "firmware", "alerts"):
        table.add_column(name)
    for row in rows:
        table.add_row(
            printable(row.gateway),
            printable(row.wearer or "–"),
            row.state,
            f"{row.rate_hz:.1f}",
            f"{row.loss:.1%}",
            "–" if row.delay_ms is None else f"{row.delay_ms:.0f}",
            str(row.lost),
            str(row.late),
            "–" if row.free_gb is None else f"{row.free_gb:.0f}",
            printable(row.version or "–"),
            printable(", ".join(row.firmware) or "–"),
            printable("; ".join(row.alerts)),
            style="bold red" if row.alerts else "",
        )
    return table


archive_app = typer.Typer(
    help="What a fleet has measured, as Parquet files by site, day and wearer.",
    epilog="Example: mocap-gateway fleet archive list --archive clinic",
    no_args_is_help=True,
    add_completion=False,
)
fleet_app.add_typer(archive_app, name="archive")

ArchiveFolder = Annotated[Path, typer.Option("--archive", help="Folder of the archive.")]
Site = Annotated[str, typer.Option(help="Name of the place.")]


@archive_app.command(
    epilog="Example: mocap-gateway fleet archive collect --archive clinic --site ward2 --wearers w.yaml"
)
@with_broker
def collect(
    broker: BrokerChoice,
    archive: ArchiveFolder,
    site: Site,
    wearers: Wearers = None,
    seconds: Annotated[float | None, typer.Option(min=1, help="End after so long; else on Ctrl-C.")] = None,
    flush: Annotated[float, typer.Option(min=1, max=3600, help="Write what waits so often, s.")] = 60,
) -> None:
    """Keep the poses that all gateways publish, live and late ones, none twice."""
    from gateway.fleet.archive import Archive
    from gateway.fleet.collecting import Collector

    settings, names = broker.settings(), read_wearers(wearers)
    kept = Archive(archive, is_new=True)
    collector = Collector(kept, site, settings.base_topic, names)
    _end_on_sigterm()
    with kept.collecting(site):
        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(_for_a_while(_collect(settings, collector, flush), seconds))
        try:
            with kept.locked("collect", _LAST_FLUSH_S):
                collector.flush()
                files = kept.renew_catalogue()
        finally:
            if collector.waiting:
                typer.echo(f"{collector.waiting} poses could not be written, and are lost", err=True)
    typer.echo(
        f"{collector.rows} poses kept, {collector.repeated} were there already, "
        f"{collector.undecodable} not readable, {collector.missed} came too fast to be kept; {files} files"
    )


async def _collect(settings: MqttSettings, collector: Collector, flush_s: float) -> None:
    from gateway.fleet.archive import ArchiveError
    from gateway.fleet.overview import listener
    from gateway.outputs.connection import first_to_end

    async def write() -> None:
        due_s = time.monotonic() + flush_s
        while True:
            await asyncio.sleep(_LOOK_S)
            if time.monotonic() < due_s and not collector.is_full:
                continue
            try:
                with collector.archive.locked("collect"):
                    collector.flush()
            except (ArchiveError, OSError) as error:
                typer.echo(f"{error}: {collector.waiting} poses wait until they can be written", err=True)
                await asyncio.sleep(_AFTER_TROUBLE_S)
            due_s = time.monotonic() + flush_s

    receiver = listener(settings, collector.take)
    try:
        await first_to_end(receiver.run(), write())
    finally:
        collector.missed += receiver.dropped


@archive_app.command(
    epilog="Example: mocap-gateway fleet archive add walk.mcap --archive clinic --site ward2 --wearer anna"
)
def add(
    recordings: Annotated[list[Path], typer.Argument(help="Finished recordings.")],
    archive: ArchiveFolder,
    site: Site,
    wearer: Annotated[str, typer.Option(help="Name of who wore the suit; a pseudonym is kept of it.")],
) -> None:
    """Take in finished recordings: their bytes, and the poses that they hold."""
    from gateway.fleet.archive import Archive
    from gateway.recording import open_recording

    kept = Archive(archive, is_new=True)
    with kept.locked("add"):
        try:
            for path in recordings:
                added = kept.add(open_recording(path), path, site, wearer)
                written = f"{added.rows} poses" if added.rows else _WITHOUT_ROWS[added.is_new]
                typer.echo(f"{path}: {written}, wearer {kept.pseudonym(wearer)}")
        finally:
            kept.renew_catalogue()


_WITHOUT_ROWS = {
    True: "kept; it holds no poses, `fleet archive solve` makes them",
    False: "was there already",
}
"""Of a recording that gives no rows, by whether it is new."""


@archive_app.command("list", epilog="Example: mocap-gateway fleet archive list --archive clinic")
def list_archive(archive: ArchiveFolder) -> None:
    """Show the catalogue, by method, site, day and wearer."""
    from gateway.fleet.archive import Archive

    _ask(
        archive,
        "SELECT method, site, day, wearer, count(*) AS files, sum(rows)::BIGINT AS rows, "
        "round(sum(bytes) / 1e6, 2) AS mb FROM catalogue GROUP BY ALL ORDER BY ALL",
    )
    typer.echo(f"{len(Archive(archive).kept_recordings())} recordings are kept, to be solved again", err=True)


@archive_app.command(
    epilog="Example: mocap-gateway fleet archive query --archive clinic "
    "\"SELECT wearer, max(right_knee_flexion_deg) FROM poses WHERE dayname(day) = 'Tuesday' GROUP BY wearer\""
)
def query(
    sql: Annotated[str, typer.Argument(help="SQL of DuckDB; the tables are poses and catalogue.")],
    archive: ArchiveFolder,
) -> None:
    """Ask the archive in SQL, and print the answer as CSV."""
    _ask(archive, sql)


def _ask(folder: Path, sql: str) -> None:
    from gateway.fleet.archive import Archive

    names, rows = Archive(folder).query(sql)
    lines = csv.writer(sys.stdout, lineterminator="\n")
    if names:
        lines.writerow(names)
    for row in rows:
        lines.writerow("" if value is None else printable(str(value)) for value in row)


@archive_app.command(
    epilog="Example: mocap-gateway fleet archive solve --archive clinic --method independent --workers 2"
)
def solve(
    archive: ArchiveFolder,
    method: Annotated[str, typer.Option(help="Method that makes the poses anew.")],
    workers: Annotated[int, typer.Option(min=1, max=256, help="Processes on this machine.")] = 1,
    dask: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, instead of processes here.")
    ] = None,
) -> None:
    """Solve all recordings again with another method, beside what is there. Begun anew, it goes on."""
    from gateway.cli.terminal import progress_bar
    from gateway.fleet.archive import Archive
    from gateway.fleet.solving import SolvedRecording, jobs_of, run
    from gateway.settings import check_method

    check_method(method, "--method")
    kept = Archive(archive)
    jobs, outcomes = jobs_of(kept, method), list[SolvedRecording]()
    with kept.locked("solve"):
        with progress_bar("solving") as progress:

            def done(outcome: SolvedRecording) -> None:
                outcomes.append(outcome)
                progress(len(outcomes), len(jobs))

            run(jobs, done, workers, dask)
        kept.renew_catalogue()
    failed = [outcome for outcome in outcomes if outcome.error is not None]
    typer.echo(
        f"{sum(outcome.rows > 0 for outcome in outcomes)} recordings solved, "
        f"{sum(outcome.was_there for outcome in outcomes)} were there, {len(failed)} failed"
    )
    for outcome in failed:
        typer.echo(f"{outcome.recording}: {outcome.error}", err=True)
    if failed:
        raise typer.Exit(1)


@archive_app.command(epilog="Example: mocap-gateway fleet archive forget anna --archive clinic --yes")
def forget(
    wearer: Annotated[str, typer.Argument(help="Name of the wearer.")],
    archive: ArchiveFolder,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Delete all that is kept of one wearer, and look whether a file still names them. Ends with 1 if so."""
    from gateway.fleet.archive import Archive

    kept = Archive(archive)
    who = f"{printable(wearer)} ({kept.pseudonym(wearer)})"
    with kept.nobody_collects(), kept.locked("forget"):
        if not yes:
            files = sum(len(list(folder.iterdir())) for folder in kept.folders_of(wearer))
            typer.confirm(f"Delete all that {archive} keeps of {who}: {files} files?", abort=True)
        files, left = kept.forget(wearer)
    if not files and not left:
        raise GatewayError(
            f"{archive} keeps nothing of {who}: give the name as `add` or the file of --wearers had it; "
            "a gateway without a wearer goes by its own name"
        )
    typer.echo(f"{files} files deleted; {left} files still hold the name or the pseudonym")
    for path in kept.traces(wearer) if left else ():
        typer.echo(f"  {path}", err=True)
    if left:
        raise typer.Exit(1)


@archive_app.command(
    epilog="Example: mocap-gateway fleet archive expire --archive clinic --before 2026-01-01"
)
def expire(
    archive: ArchiveFolder,
    before: Annotated[datetime, typer.Option(formats=["%Y-%m-%d"], help="First day that is kept.")],
) -> None:
    """Delete all of the days before one: retention, to be called once a day."""
    from gateway.fleet.archive import Archive

    day = before.strftime("%Y-%m-%d")
    if before.date() > datetime.now(UTC).date():
        raise GatewayError(
            f"--before {day}: that day is to come, and nothing would be kept: name today's, or one before"
        )
    kept = Archive(archive)
    with kept.locked("expire"):
        files = kept.expire(day)
    typer.echo(f"{files} files deleted")
