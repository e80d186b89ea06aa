"""``mocap-gateway demo``: emulated suit → gateway → embedded broker → orientations, and their error."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console
from rich.live import Live
from rich.table import Table

from devices.extras import how_to_add
from devices.free_ports import free_port
from devices.link import gateway_time_ns
from gateway.body.skeleton import WornSuit
from gateway.cli.preparing import report_compiling, stand_in
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.geometry.comparison import orientation_error, rmse_deg
from gateway.outputs.settings import MqttSettings, PoseMap
from gateway.reconstruction import FUSED
from gateway.settings import ClockSettings, GatewaySettings
from gateway.sources.clock_mode import ClockMode
from gateway.sources.link_settings import LinkSettings

if TYPE_CHECKING:
    from gateway.outputs.subscriber import ReceivedPose
    from gateway.service.service import Service
    from gateway.sources.suit import SuitSource


SETTLING_S = 3.0
"""Left out of the error: filters start anywhere."""
SEED = 1
_MOST_LOST = 0.02
"""Share of the samples, beyond what is lost on purpose."""
_LATEST_S = 0.1


class Truth:
    """The emulated body's motion, and what was received of it."""

    def __init__(self, suit: WornSuit) -> None:
        from gateway.emulation.rig import dress, perform

        self.segment_names = suit.skeleton.segment_names
        self.start_ns = 0
        self._motion = perform(dress(suit), suit.skeleton.name, SEED)
        self._times_s: list[float] = []
        self._late_s: list[float] = []
        self._q_wb: list[list[list[float]]] = []

    def add(self, received: ReceivedPose) -> None:
        """Keep a pose."""
        undefined = [float("nan")] * 4
        segments = received.pose.segments
        self._times_s.append((received.pose.t_ns - self.start_ns) * 1e-9)
        self._late_s.append(received.latency_s)
        self._q_wb.append([list(segments[name] or undefined) for name in self.segment_names])

    @property
    def n_poses(self) -> int:
        """How many poses were compared."""
        return len(self._times_s)

    def errors_deg(self) -> FloatArray:
        """Return the RMSE by segment after settling, °, (n_segments, 3): total, inclination, heading."""
        times = np.array(self._times_s)
        settled = times > SETTLING_S
        if not settled.any():
            return np.full((len(self.segment_names), 3), np.nan)
        errors = orientation_error(np.array(self._q_wb)[settled], self._motion.state(times[settled]).q_wb)
        return np.stack([rmse_deg(part) for part in errors], axis=-1)

    def busy_note(self, stream: SuitSource, expected_loss: float) -> str | None:
        """Return a note that this machine did not keep up with a suit in real time; None where it did.

        stream: of the gateway; what it never got could not be handed over in time, but for the
        ``expected_loss`` (share) that is emulated.
        """
        lost = sum(record.lost for record in stream.modules.values())
        share = lost / max(1, lost + sum(record.received for record in stream.modules.values()))
        late_s = float(np.percentile(self._late_s, 95)) if self._late_s else 0.0
        if share <= expected_loss + _MOST_LOST and late_s <= _LATEST_S:
            return None
        return (
            f"this machine was too busy for a suit in real time: {share:.0%} of the samples were lost, and "
            f"5 % of the poses came more than {late_s * 1e3:.0f} ms late. The errors include that: "
            "try again when less else is running"
        )


GATEWAY = "demo"


def demo(
    seconds: Annotated[float, typer.Option(min=5, help="How long to run.")] = 20.0,
    keep: Annotated[bool, typer.Option("--keep", help="Run until Ctrl-C, for your own subscribers.")] = False,
    rig: Annotated[str, typer.Option(help="Rig to emulate (see config/rigs).")] = "suit_17",
    reconstructor: Annotated[
        str | None,
        typer.Option(help="joint, independent, fused_neutral, …; else joint, once it is compiled."),
    ] = None,
    imperfections: Annotated[str, typer.Option(help="ideal, typical or rough.")] = "typical",
    clock: Annotated[
        ClockMode, typer.Option(help="estimated, shared, or trigger: the gateway says when modules sample.")
    ] = ClockMode.ESTIMATED,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Broker port; if busy a free one.")] = 1883,
    websocket_port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, help="The broker serves WebSockets there too, for pages of your own."),
    ] = None,
    page: Annotated[bool, typer.Option(help="Show the body on a live page in the browser.")] = True,
    page_port: Annotated[int, typer.Option(min=1, max=65535, help="Its port; if busy a free one.")] = 8080,
) -> None:
    """See it work, without any hardware or broker.

    Emulates a person in a suit of 17 modules, runs the gateway on it, publishes over the embedded
    broker, subscribes like an app would, and prints orientations and their error against the
    emulator's truth.
    """
    from devices.emulators.imperfections import PRESETS
    from gateway.body.rig import load_rig

    # However it is ended, also in the background of a script, the emulated suit and the page end with it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    console = Console()
    suit = load_rig(rig)
    truth, is_interrupted = Truth(suit), True
    with tempfile.TemporaryDirectory(prefix="mocap-demo-") as folder, contextlib.suppress(KeyboardInterrupt):
        ports = _port_or_free(port), websocket_port
        settings = _demo_settings(f"{folder}/suit", rig, reconstructor, clock, ports)
        show = partial(console.print, style="dim")
        usual = settings.reconstructor
        if reconstructor is None:
            settings = _startable(settings, show)
        service = _demo_service(settings, suit, usual, show)

        with contextlib.ExitStack() as beside:
            beside.enter_context(_live_page(settings, _port_or_free(page_port) if page else None, console))
            running = _run(service, settings, truth, imperfections, None if keep else seconds, beside)
            asyncio.run(running)
        is_interrupted = False

    if is_interrupted and not truth.n_poses:
        console.print("ended before the first pose came", style="dim")
    else:
        _print_errors(truth, console)
        if note := truth.busy_note(service.pipeline.stream, PRESETS[imperfections].loss):
            console.print(note, style="yellow", highlight=False)


def _demo_settings(
    link: str, rig: str, reconstructor: str | None, clock: ClockMode, ports: tuple[int, int | None]
) -> GatewaySettings:
    """Return the settings of a gateway on ``link`` with its own broker; ports: of MQTT, of WebSockets."""
    return GatewaySettings(
        gateway=GATEWAY,
        links=[LinkSettings(name="suit", url=link)],
        rig=rig,
        reconstructor=reconstructor or GatewaySettings.model_fields["reconstructor"].default,
        clock=ClockSettings(mode=clock),
        mqtt=MqttSettings(
            broker="embedded",
            port=ports[0],
            websocket_port=ports[1],
            include=frozenset({PoseMap.POSITION}),
        ),
    )


def _demo_service(
    settings: GatewaySettings, suit: WornSuit, usual: str, show: Callable[[str], object]
) -> Service:
    """Return the service, not yet running, whose health can be asked for over MQTT as with ``run``.

    usual: the method that poses come from once it is compiled, if that of the settings is another one.
    """
    from gateway.doctor.inside import examined
    from gateway.service.service import Service

    with report_compiling(show):
        service = Service(settings, suit, awaited=usual if settings.reconstructor != usual else None)
    service.own_requests.on_examine = partial(examined, service)
    return service


def _startable(settings: GatewaySettings, show: Callable[[str], object]) -> GatewaySettings:
    """Return the settings; where their reconstructor is not compiled yet, with another, and it is for next
    time."""
    from gateway.service import readiness

    usual = settings.reconstructor
    if readiness.is_ready(usual):
        return settings
    settings = stand_in(settings, show)
    show(
        f"first start: '{usual}' is compiled in the background; this run shows "
        f"'{readiness.FALLBACK}', and the body stays in its place"
    )
    nowhere = subprocess.DEVNULL
    # In a session of its own the compiler goes on when the demo ends or is interrupted.
    subprocess.Popen(readiness.command(usual), stdout=nowhere, stderr=nowhere, start_new_session=True)
    return settings


def _companion(*arguments: str) -> list[str]:
    """Return what runs another command beside this one, and not beyond it."""
    return [sys.executable, "-m", "gateway.cli.companion", str(os.getpid()), *arguments]


@contextlib.contextmanager
def _live_page(settings: GatewaySettings, page_port: int | None, console: Console) -> Iterator[None]:
    """Run ``mocap-gateway view`` as a process of its own meanwhile; print a hint without the extra."""
    if page_port is None:
        yield
        return
    if importlib.util.find_spec("viser") is None:
        console.print(f"no live page: {how_to_add('viewer')} for one", style="dim")
        yield
        return
    arguments = ["view", "--wait", "--port", str(settings.mqtt.port), "--gateway", settings.gateway]
    process = subprocess.Popen(_companion(*arguments, "--page-port", str(page_port)))
    try:
        yield
    finally:
        process.terminate()
        # The page may hang in its own shutdown, and must not keep the demo from ending.
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5)
        process.kill()


async def _run(
    service: Service,
    settings: GatewaySettings,
    truth: Truth,
    imperfections: str,
    seconds: float | None,
    beside: contextlib.ExitStack,
) -> None:
    """Run service and emulator until the end of the demo; ``beside`` closes before the broker does."""
    async with _emulator(settings, imperfections) as start_ns:
        truth.start_ns = start_ns
        serving = asyncio.create_task(service.run())
        watching = asyncio.create_task(_watch(service, settings, truth, seconds))
        try:
            await asyncio.wait({serving, watching}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            beside.close()
        for task in (watching, serving):
            task.cancel()
        # Both are gathered before any error is raised: the other task must not outlive the demo.
        results = await asyncio.gather(watching, serving, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result


@contextlib.asynccontextmanager
async def _emulator(settings: GatewaySettings, imperfections: str) -> AsyncIterator[int]:
    """Run the emulated suit as a process of its own; yield the gateway time at which its motion starts."""
    arguments = ["emulate", "--rig", settings.rig, "--on", "pty", "--link", settings.links[0].url]
    arguments += ["--imperfections", imperfections, "--seed", str(SEED), "--json"]
    arguments += ["--mode", _sampling_mode(settings), "--motion", "everyday"]
    process = await asyncio.create_subprocess_exec(*_companion(*arguments), stdout=asyncio.subprocess.PIPE)
    assert process.stdout is not None
    try:
        hello = await process.stdout.readline()
        if not hello:
            raise GatewayError("the emulated suit did not start; see its message above")
        yield int(json.loads(hello)["start_ns"])
    finally:
        with contextlib.suppress(ProcessLookupError):
            # The process may have ended by itself, as after an error.
            process.terminate()
        await process.wait()


def _sampling_mode(settings: GatewaySettings) -> str:
    """Return what the emulated modules are to be set to."""
    if settings.reconstructor in FUSED:
        return "fused"
    return "triggered" if settings.clock.mode is ClockMode.TRIGGER else "raw"


async def _watch(service: Service, settings: GatewaySettings, truth: Truth, seconds: float | None) -> None:
    """Subscribe as an app would; show what comes until the time is over."""
    from gateway.outputs.subscriber import PoseSubscriber

    while not service.mqtt.is_connected:  # noqa: ASYNC110 - polled for a second, once
        await asyncio.sleep(0.05)
    console = Console()
    _print_invitation(console, settings, service.mqtt.port)
    mqtt = settings.mqtt.model_copy(update={"broker": "external", "port": service.mqtt.port})
    end_ns = None if seconds is None else gateway_time_ns() + round(seconds * 1e9)
    async with PoseSubscriber(mqtt, settings.gateway) as poses, _screen(console) as screen:
        async for received in poses:
            truth.add(received)
            screen.show(received, poses.states.get(settings.gateway, "state unknown"))
            if end_ns is not None and received.received_ns > end_ns:
                return


class _Screen:
    """A live table on a terminal; a line a second elsewhere."""

    INTERVAL_NS = 100_000_000
    LINE_INTERVAL_NS = 1_000_000_000

    def __init__(self, console: Console, live: Live | None) -> None:
        from gateway.viewer.pose_table import PoseView

        self._console = console
        self._live = live
        self._view = PoseView(GATEWAY)
        self._due_ns = 0

    def show(self, received: ReceivedPose, state: str) -> None:
        """Take a pose; not every one is drawn."""
        self._view.add(received)
        now_ns = received.received_ns
        # Poses come faster than anybody reads a table.
        if now_ns < self._due_ns:
            return
        if self._live is not None:
            self._due_ns = now_ns + self.INTERVAL_NS
            self._live.update(self._view.table(now_ns, state), refresh=True)
            return
        self._due_ns = now_ns + self.LINE_INTERVAL_NS
        root = received.pose.root
        rate = self._view.rate_hz
        self._console.print(
            f"pose {received.pose.seq:6d}  {rate or 0.0:5.1f} Hz  "
            f"latency {received.latency_s * 1e3:5.1f} ms  {root} [w x y z] {received.pose.segments[root]}",
            soft_wrap=True,
            highlight=False,
        )


@contextlib.asynccontextmanager
async def _screen(console: Console) -> AsyncIterator[_Screen]:
    if not console.is_terminal:
        yield _Screen(console, None)
        return
    with Live(console=console, auto_refresh=False) as live:
        yield _Screen(console, live)


def _print_invitation(console: Console, settings: GatewaySettings, port: int) -> None:

    console.print(
        f"emulated suit on {settings.links[0].url}; MQTT broker on 127.0.0.1:{port}. Meanwhile, elsewhere:\n"
        f"  mosquitto_sub -p {port} -t 'mocap/{settings.gateway}/pose'\n"
        f"  mocap-gateway watch --port {port}\n",
        highlight=False,
        soft_wrap=True,
    )


def _print_errors(truth: Truth, console: Console) -> None:
    """Print the error of what came over MQTT. Raises ``GatewayError`` when nothing came."""
    if truth.n_poses == 0:
        raise GatewayError("no pose came out of MQTT: see the messages above")
    errors = truth.errors_deg()
    table = Table(
        title=f"error of {truth.n_poses} poses received over MQTT, RMSE in degrees after {SETTLING_S:g} s",
        title_justify="left",
    )
    for column in ("segment", "total", "inclination", "heading"):
        table.add_column(column, justify="left" if column == "segment" else "right")
    for name, row in zip(truth.segment_names, errors, strict=True):
        table.add_row(name, *(f"{value:.2f}" for value in row))
    table.add_section()
    mean = np.nanmean(errors, axis=0)
    table.add_row("mean", *(f"{value:.2f}" for value in mean), style="bold")
    console.print(table)
    if np.isfinite(mean[0]):
        console.print(
            f"This means: a segment was shown {mean[0]:.1f}° off the emulated body's own on average, "
            f"{mean[1]:.1f}° of it as tilt and {mean[2]:.1f}° as heading.",
            highlight=False,
        )


def _port_or_free(preferred: int) -> int:
    """Return the preferred port of the loopback interface, or another one when it is taken."""
    with socket.socket() as probe, contextlib.suppress(OSError):
        # The port of a demo that has just ended may still be in TIME_WAIT, and can be had all the same.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", preferred))
        return preferred
    return free_port()
