"""``mocap-gateway run`` and ``record``: the service, publishing; and recording too."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.live import Live
from rich.table import Table

from gateway.cli.preparing import make_ready, report_compiling, stand_in
from gateway.errors import GatewayError
from gateway.reconstruction import OPTICAL
from gateway.service.systemd import feed_watchdog, notify
from gateway.settings import GatewaySettings, fitting_suit, load_gateway_settings
from gateway.support.log_format import set_up_logging

if TYPE_CHECKING:
    from gateway.body.skeleton import WornSuit
    from gateway.service.service import Service


log = logging.getLogger(__name__)

_ANSWER_TIME_S = 0.5
"""From a request to read the configuration to the new service: the old one has to answer."""


def run(
    config: Path = typer.Option(
        Path("config/gateway.yaml"), "--config", "-c", help="Configuration file (see `config schema`)."
    ),
) -> None:
    """Read the suit, reconstruct, publish. Ends on Ctrl-C or SIGTERM; SIGHUP reads the configuration anew.

    A link that is absent is waited for; a broker that is away is tried again and again. A changed
    configuration that is wrong is reported, and the service goes on with the one it has.
    """
    from gateway.body.rig import load_rig
    from gateway.service.remote_configuration import go_back_if_unconfirmed

    go_back_if_unconfirmed(config)
    configured = load_gateway_settings(config)
    suit = load_rig(configured.rig, config)
    awaited = _awaited(fitting_suit(configured, suit).reconstructor, suit)
    set_up_logging(configured.log.level, configured.log.format)
    service = _load(config, awaited=awaited)
    _log_start(service)
    asyncio.run(_Supervisor(config, service, awaited).run())


def _awaited(wanted: str, suit: WornSuit) -> str | None:
    """Return the method that another one stands in for until it is compiled; None: it can begin.

    One that no other can stand in for is compiled here: of markers, and where both fields are used. What
    cameras need is compiled with their first pictures.
    """
    from gateway.service import readiness

    has_no_stand_in = wanted == OPTICAL or (suit.sun is not None and suit.sun.beside_magnetometer)
    if has_no_stand_in and suit.video is None:
        make_ready(wanted)
    return None if readiness.is_ready(wanted) else wanted


def _load(config: Path, awaited: str | None = None) -> Service:
    """Return the service that a configuration describes, or what stands in for it while its method
    ``awaited`` is compiled. Raises ``GatewayError`` with what is wrong in it."""
    from gateway.body.rig import load_rig
    from gateway.service.further_bodies import further_bodies
    from gateway.service.service import Service

    settings = load_gateway_settings(config)
    suit = load_rig(settings.rig, config)
    others = further_bodies(settings, config)
    if awaited is not None:
        settings = stand_in(settings, log.info)
    with report_compiling(log.info):
        return Service(settings, suit, awaited=awaited, others=others, config=config)


def _log_start(service: Service) -> None:
    settings, suit = service.settings, service.pipeline.suit
    links = ", ".join(f"{link.name} ({link.url})" for link in settings.links)
    n_modules, body = len(suit.module_ids), suit.skeleton.name
    log.info("gateway '%s': %d modules on '%s', links %s", settings.gateway, n_modules, body, links)


class _Supervisor:
    """Runs one service after another: a new one for every configuration that is read."""

    def __init__(self, config: Path, service: Service, to_compile: str | None = None) -> None:
        """Run ``service``; ``to_compile`` is a method that must be compiled before the configured one can
        run.
        """
        from gateway.service.remote_configuration import RemoteConfiguration

        self._config = config
        self._remote = RemoteConfiguration(config, self._read_anew)
        self._to_compile = to_compile
        self._service = service
        self._task: asyncio.Task[None] | None = None
        self._next: Service | None = None
        """Prepared: it takes over when the running one has ended."""
        self._former: Service | None = None
        """What ran before: gone back to should the new one fail as it starts."""
        self._is_settled = asyncio.Event()
        self._is_settled.set()
        self._reloading: asyncio.Task[None] | None = None
        self._reading = asyncio.Lock()

    async def run(self) -> None:
        """Run services one after another until a signal ends them."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self._stop)
        # As daemons do: SIGHUP reads the configuration anew.
        loop.add_signal_handler(signal.SIGHUP, self._reload)
        watchdog = asyncio.create_task(feed_watchdog(lambda: self._service.can_flow), name="watchdog")
        compiling = asyncio.create_task(self._compile(), name="compiling")
        try:
            while await self._run_once():
                pass
        finally:
            compiling.cancel()
            watchdog.cancel()

    async def _compile(self) -> None:
        """Compile in a process of its own, then restart the service with the method that is configured."""
        from gateway.service import readiness

        name = self._to_compile
        if name is None:
            return
        # Walking is compiled, too, so that the stand-in may be the method itself.
        serves = "" if name == readiness.FALLBACK else f"'{readiness.FALLBACK}' makes the poses, and "
        log.warning(
            "compiling the method '%s' in the background, once after an installation; until then %sthe body "
            "stays in its place", name, serves,
        )  # fmt: skip
        process = await asyncio.create_subprocess_exec(*readiness.command(name))
        try:
            status = await process.wait()
        except asyncio.CancelledError:
            process.terminate()
            raise
        if status == -signal.SIGINT:
            return  # Ctrl-C reached that process first, and is about to end this one
        if status != 0:
            log.error("compiling '%s' failed (status %d): '%s' stays", name, status, readiness.FALLBACK)
            return
        log.info("compiled: '%s' takes over", name)
        await self._load_next()

    async def _run_once(self) -> bool:
        """Return one service to its end; True if another one follows."""
        from gateway.doctor.inside import examined
        from gateway.doctor.port_choice import PortChoice
        from gateway.service.service import Service

        service = self._service
        service.own_requests.on_reload = self._read_anew
        service.own_requests.on_examine = partial(examined, service)
        service.own_requests.on_connect = PortChoice(self._config, service, self._read_anew).connect
        service.own_requests.on_configure = self._remote.configure
        service.own_requests.on_confirm = self._remote.confirm
        # As a task, so that a new configuration or a signal can end it.
        self._task = asyncio.ensure_future(service.run())
        notify("READY=1", f"STATUS=publishing, configuration {self._config}")
        try:
            await self._task
        except asyncio.CancelledError:
            own = asyncio.current_task()
            if own is not None and own.cancelling():  # not the service alone: none follows it
                raise
            if self._next is None:
                log.info("stopped")
        except GatewayError as error:
            # Only a service that never began is replaced by the one before; one that ran and failed is an
            # error.
            if self._former is None or service.begun.is_set():
                raise
            log.error("the changed configuration cannot run, the old one goes on: %s", error)
            former, self._former = self._former, None
            others = former.others
            again = Service(former.settings, former.pipeline.suit, others=others, config=self._config)
            again.requests.follow(service.requests)
            self._take(again)
            return True
        if self._next is None:
            return False
        # Kept until the next one has begun: it is gone back to if that fails.
        self._former = service
        self._take(self._next)
        log.info("configuration read anew")
        return True

    def _take(self, service: Service) -> None:
        """Make a service the one that runs next."""
        self._service, self._next = service, None
        self._is_settled.set()
        set_up_logging(service.settings.log.level, service.settings.log.format)
        _log_start(service)

    def _stop(self) -> None:
        notify("STOPPING=1")
        self._next = None
        if self._task is not None:
            self._task.cancel()

    def _reload(self) -> None:
        if self._reloading is None or self._reloading.done():
            self._reloading = asyncio.create_task(self._load_next(), name="reload")

    async def _load_next(self) -> None:
        async with self._reading:
            await self._is_settled.wait()
            with contextlib.suppress(GatewayError):
                await self._prepare_next(switch_after_s=0.0)

    async def _read_anew(self, switch_after_s: float = _ANSWER_TIME_S) -> None:
        """Data flows on while the new configuration is read, its reconstructor compiled, and all that it
        needs bound, opened and checked.

        switch_after_s: time for the old service to answer the request. Raises ``GatewayError``
        for a configuration that is wrong, or that cannot run here; the old service then goes on.
        """
        if self._reading.locked() or self._next is not None:
            raise GatewayError("another configuration takes over just now: ask again in a moment")
        async with self._reading:
            await self._prepare_next(switch_after_s)

    async def _prepare_next(self, switch_after_s: float) -> None:
        """As ``_read_anew``, for who has the turn: two services that are prepared at once want the same
        ports."""
        notify("RELOADING=1")
        try:
            service = await self._prepared()
        except GatewayError as error:
            log.error("the changed configuration is not taken, the old one stays: %s", error)
            raise
        finally:
            # In any case: to the service manager a reload that fails is a reload that is over.
            notify("READY=1")
        self._next = service
        self._is_settled.clear()
        if self._task is not None:
            # The answer to the request goes out over the service that is about to end.
            asyncio.get_running_loop().call_later(switch_after_s, self._task.cancel)

    async def _prepared(self) -> Service:
        """Return the service that the file describes now, ready to run. Raises ``GatewayError``."""
        try:
            service = await asyncio.to_thread(_load, self._config)
            await service.prepare(self._service)
        except GatewayError:
            raise
        except Exception as error:  # the running service must not end for it
            log.exception("the configuration could not be read anew")
            raise GatewayError(f"this should not have happened ({error!r}); please report it") from error
        return service


async def until_signal(service: Service) -> None:
    """Run a service until it ends, or SIGINT or SIGTERM comes."""
    task = asyncio.ensure_future(service.run())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    try:
        await task
    except asyncio.CancelledError:
        log.info("stopped")


REFRESH_S = 0.5


def record(
    config: Annotated[Path, typer.Option("--config", "-c", help="Configuration file.")] = Path(
        "config/gateway.yaml"
    ),
    name: Annotated[str | None, typer.Option(help="Added to the file's name.")] = None,
    folder: Annotated[Path | None, typer.Option(help="Where files go; else recording.folder.")] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after so long; else Ctrl-C.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No live counters.")] = False,
) -> None:
    """Run the gateway and record everything: raw bytes, what was sent, poses, events.

    Reads the suit and publishes as `run` does. Ends with a whole file on Ctrl-C or SIGTERM; with 1 when the
    recording had to end before that.
    """
    from gateway.body.rig import load_rig
    from gateway.doctor.inside import examined
    from gateway.service.further_bodies import further_bodies
    from gateway.service.service import Service

    settings = load_gateway_settings(config)
    changes = {"name": name, "folder": None if folder is None else str(folder)}
    wanted = {key: value for key, value in changes.items() if value is not None}
    recording = settings.recording.model_copy(update={"at_start": True, **wanted})
    settings = settings.model_copy(update={"recording": recording})
    suit = load_rig(settings.rig, config)

    set_up_logging(settings.log.level, settings.log.format)
    make_ready(fitting_suit(settings, suit).reconstructor)
    with report_compiling(partial(typer.echo, err=True)):
        service = Service(settings, suit, others=further_bodies(settings, config))
    service.own_requests.on_examine = partial(examined, service)
    asyncio.run(_record(service, settings, seconds, None if quiet else Console(stderr=True)))

    status = service.recording.status()
    if "file" not in status:
        raise GatewayError("nothing was recorded: it was ended before it had begun")
    typer.echo(
        f"{status['file']}: {status['seconds']:.1f} s, {status['bytes'] / 1e6:.1f} MB, "
        f"{status['written'].get('chunks', 0)} chunks, {status['written'].get('skeleton', 0)} poses"
        + (f", {status['part']} files" if status["part"] > 1 else "")
    )
    if not status["written"].get("chunks", 0):
        typer.echo(
            f"note: nothing came over any link: `mocap-gateway doctor -c {config}` looks why", err=True
        )
    if status.get("ended") != "stopped":
        typer.echo(f"the recording had to end: {status.get('ended')}", err=True)
        raise typer.Exit(1)


async def _record(
    service: Service, settings: GatewaySettings, seconds: float | None, console: Console | None
) -> None:
    running = asyncio.ensure_future(until_signal(service))
    if seconds is not None:
        running.add_done_callback(asyncio.create_task(_end_after(seconds, service, running)).cancel)
    if console is not None and console.is_terminal:
        with Live(console=console, transient=True, auto_refresh=False) as live:
            while not running.done():
                live.update(_screen(service, settings), refresh=True)
                await asyncio.wait({running}, timeout=REFRESH_S)
    try:
        await running
    except asyncio.CancelledError:
        logging.getLogger(__name__).info("the time is over")


async def _end_after(seconds: float, service: Service, running: asyncio.Future[None]) -> None:
    """Cancel what runs so long after it has begun to record: outputs may take a while to start."""
    await service.begun.wait()
    await asyncio.sleep(seconds)
    # Cancelled while it ends, it would lose what it ends with.
    if not service.is_ending:
        running.cancel()


def _screen(service: Service, settings: GatewaySettings) -> Table:
    """Return the counters as they stand."""
    status = service.recording.status()
    modules = service.pipeline.stream.modules.values()
    written, lost = status.get("written", {}), sum(status.get("lost", {}).values())
    screen = Table.grid(padding=(0, 2))
    state = status["state"]
    shown = f"[green]{state}[/]" if state == "recording" else f"[red]{status.get('ended', state)}[/]"
    screen.add_row(shown, str(status.get("file", "")))
    screen.add_row(
        f"{status.get('seconds', 0):.0f} s",
        f"{status.get('bytes', 0) / 1e6:.1f} MB, {written.get('chunks', 0)} chunks, "
        f"{written.get('skeleton', 0)} poses; not recorded {lost}; "
        f"waited for the disk {status.get('stalls', 0)}×",
    )
    screen.add_row(
        f"{len(modules)} modules",
        f"packets received {sum(record.received for record in modules)}, "
        f"lost {sum(record.lost for record in modules)}; "
        + ("broker connected" if service.mqtt.is_connected else f"NO BROKER at {settings.mqtt.host}"),
    )
    if "warning" in status:
        screen.add_row("[yellow]disk[/]", status["warning"])
    screen.add_row("", "[dim]Ctrl-C ends the recording[/]")
    return screen
