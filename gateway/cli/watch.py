"""``mocap-gateway watch`` and ``view``: what a gateway publishes, in the terminal and on a page."""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from devices.link import gateway_time_ns
from gateway.cli.options import BrokerChoice, with_broker
from gateway.cli.terminal import progress_bar
from gateway.contract.topics import ANY_GATEWAY
from gateway.errors import GatewayError
from gateway.outputs.settings import MqttSettings
from gateway.support.credentials import AccessToken, CredentialError, read_secret, token_for
from gateway.support.extras import require_package
from gateway.support.names import printable

if TYPE_CHECKING:
    import viser

    from gateway.outputs.subscriber import PoseSubscriber
    from gateway.viewer.pose_table import PoseView

_REFRESH_S = 0.1


@dataclass(frozen=True)
class Watch:
    """What to show, and until when."""

    gateway: str = ANY_GATEWAY
    count: int | None = None
    """End after so many poses; None: go on until interrupted."""
    as_json: bool = False
    with_quaternions: bool = False
    with_joints: bool = False
    """Show joint angles, where the poses carry them, in the place of orientations."""
    timeout: float | None = None
    """Give up after so long without a pose, s; None: wait for ever. The live table always waits."""


async def watch_poses(settings: MqttSettings, wanted: Watch, console: Console) -> int:
    """Show poses as they arrive. Returns the exit code: 0, or 1 when none came in time.

    Raises ``BrokerUnreachableError``.
    """
    from gateway.outputs.subscriber import PoseSubscriber

    async with PoseSubscriber(settings, wanted.gateway) as poses:
        try:
            if wanted.count is None and not wanted.as_json:
                await _show_live(poses, wanted, console)
            else:
                await _print_poses(poses, wanted, console)
        except TimeoutError:
            root = f"{settings.base_topic}/{wanted.gateway}"
            states = ", ".join(f"{name} is {state}" for name, state in sorted(poses.states.items()))
            known = printable(states) or "no gateway known"
            typer.echo(
                f"no pose on {root}/pose within {wanted.timeout:g} s ({known}): "
                "is the gateway running, and connected to this broker?",
                err=True,
            )
            return 1
    return 0


async def _print_poses(poses: PoseSubscriber, wanted: Watch, console: Console) -> None:
    from gateway.viewer.pose_table import PoseView

    views: dict[str, PoseView] = {}
    arriving = aiter(poses)
    shown = 0
    while wanted.count is None or shown < wanted.count:
        async with asyncio.timeout(wanted.timeout):
            received = await anext(arriving)
        shown += 1
        if wanted.as_json:
            line = received.payload.decode()  # as it was published, for a script; for people without escapes
            sys.stdout.write((printable(line) if sys.stdout.isatty() else line) + "\n")
            sys.stdout.flush()
        else:
            view = views.setdefault(received.gateway, PoseView(received.gateway))
            view.add(received)
            state = poses.states.get(received.gateway, "state unknown")
            console.print(_shown(view, received.received_ns, state, wanted))


async def _show_live(poses: PoseSubscriber, wanted: Watch, console: Console) -> None:
    from gateway.viewer.pose_table import PoseView

    views: dict[str, PoseView] = {}

    async def collect() -> None:
        async for received in poses:
            views.setdefault(received.gateway, PoseView(received.gateway)).add(received)

    with Live(console=console, auto_refresh=False) as live:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(collect())
            while True:
                live.update(_screen(poses, views, wanted), refresh=True)
                await asyncio.sleep(_REFRESH_S)


def _screen(poses: PoseSubscriber, views: dict[str, PoseView], wanted: Watch) -> RenderableType:
    from gateway.viewer.pose_table import PoseView

    for gateway in poses.states:
        # A gateway that has published its state and no pose yet is shown, too.
        views.setdefault(gateway, PoseView(gateway))
    now_ns = gateway_time_ns()
    parts: list[RenderableType] = [
        _shown(view, now_ns, poses.states.get(gateway, "state unknown"), wanted)
        for gateway, view in sorted(views.items())
    ]
    if not poses.is_connected:
        parts.append(Text("the broker is away: trying to get it back", "bold red"))
    elif not views:
        parts.append(Text("connected; no gateway has published anything yet", "yellow"))
    return Group(*parts)


def _shown(view: PoseView, now_ns: int, state: str, wanted: Watch) -> RenderableType:
    """Return one gateway as the user wants to see it."""
    from gateway.viewer.pose_table import joint_table

    if not wanted.with_joints or view.last is None:
        return view.table(now_ns, state, wanted.with_quaternions)
    joints: RenderableType | None = joint_table(view.last.pose)
    if joints is None:
        joints = Text("its poses carry no joint angles: set mqtt.include: [joint_angles]", "yellow")
    return Group(view.headline(now_ns, state), joints)


def run_watch(settings: MqttSettings, wanted: Watch) -> int:
    """Run ``watch_poses`` as a program: quiet on Ctrl-C and on a closed pipe, one line on errors."""
    from gateway.outputs.failover import BrokerUnreachableError

    try:
        return asyncio.run(watch_poses(settings, wanted, Console()))
    except KeyboardInterrupt:
        return 0
    except BrokerUnreachableError as error:
        typer.echo(str(error), err=True)
        return 1
    except BrokenPipeError:
        # The reader (such as head) has had enough; keep the interpreter from flushing into the pipe.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


@with_broker
def watch(
    broker: BrokerChoice,
    gateway: Annotated[str, typer.Option(help="Name of the gateway; + for all.")] = ANY_GATEWAY,
    once: Annotated[bool, typer.Option("--once", help="Print one pose and end.")] = False,
    count: Annotated[int | None, typer.Option(min=1, help="Print so many poses and end.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the messages as they are, one a line.")] = False,
    quaternions: Annotated[
        bool, typer.Option("--quaternions", help="Show w, x, y, z instead of heading, pitch and roll.")
    ] = False,
    joints: Annotated[
        bool, typer.Option("--joints", help="Show joint angles, where the poses carry them.")
    ] = False,
    timeout: Annotated[
        float | None,
        typer.Option(
            min=0.1, help="Give up after so many seconds without a pose (with --once, --count: 10)."
        ),
    ] = None,
) -> None:
    """Show the poses that a gateway publishes."""
    count = 1 if once else count
    if timeout is None and count is not None:
        timeout = 10.0
    settings = broker.settings()
    wanted = Watch(gateway, count, json, quaternions, joints, timeout)
    raise typer.Exit(run_watch(settings, wanted))


LOOPBACK = "127.0.0.1"
PAGE_TOKEN_VARIABLE = "MOCAP_PAGE_TOKEN"
"""Environment variable that may hold the token of the page."""
LOOKING_TOKEN_VARIABLE = "MOCAP_PAGE_LOOKING_TOKEN"
"""Environment variable that may hold the token of who may only look at it."""


@with_broker
def view(
    broker: BrokerChoice,
    recording: Annotated[
        Path | None, typer.Argument(help="A recording to play; without one, what a gateway publishes now.")
    ] = None,
    gateway: Annotated[str, typer.Option(help="Name of the gateway; + for the first heard.")] = ANY_GATEWAY,
    page_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = 8080,
    page_host: Annotated[
        str,
        typer.Option(
            help="Address that the page listens on. Elsewhere than on this machine it needs a token: "
            "whoever opens the page can also press its buttons."
        ),
    ] = LOOPBACK,
    token_file: Annotated[
        Path | None,
        typer.Option(help="File with the token that opens the page; else MOCAP_PAGE_TOKEN is taken."),
    ] = None,
    looking_token_file: Annotated[
        Path | None,
        typer.Option(
            help="File with another token, which opens the page without its buttons; else "
            "MOCAP_PAGE_LOOKING_TOKEN is taken."
        ),
    ] = None,
    muscles: Annotated[
        float | None,
        typer.Option(
            min=2,
            max=400,
            metavar="KG",
            help="Show muscles coloured by activity, of a person of this mass (extra biomech).",
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="RECORDING", help="Show another recording beside the one that is played, pale."),
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for a broker that is not there yet.")] = False,
) -> None:
    """Show the moving body on a page in the browser, live or from a recording.

    The page loads nothing from elsewhere and works on a phone. It only subscribes: it cannot slow the
    gateway down, and may run on another machine.
    """
    settings = broker.settings()
    token = token_for("the page", page_host, token_file, PAGE_TOKEN_VARIABLE, "--token-file")
    looking = looking_token(token, looking_token_file)
    place = _Place(page_host, page_port, token, looking)
    if compare is not None and recording is None:
        raise GatewayError("--compare: name the recording that is played, too: view ONE --compare OTHER")
    with contextlib.suppress(KeyboardInterrupt):
        if recording is None:
            asyncio.run(_serve_live(settings, gateway, place, wait, muscles))
        else:
            asyncio.run(_serve_recording(recording, compare, place, muscles))


def looking_token(token: AccessToken | None, file: Path | None) -> AccessToken | None:
    """Return the token of who may only look, or None. Raises ``CredentialError``."""
    text = read_secret(file, LOOKING_TOKEN_VARIABLE, "--looking-token-file")
    if text is None:
        return None
    if token is None:
        raise CredentialError(
            "--looking-token-file: without a token of who may write, everybody may: give --token-file, too"
        )
    return AccessToken(text)


class _Place(NamedTuple):
    """Where the page is, and what whoever opens it must show."""

    host: str
    port: int
    token: AccessToken | None
    looking: AccessToken | None


class _Servers(NamedTuple):
    """Pages behind the gate."""

    writing: viser.ViserServer
    looking: viser.ViserServer | None
    """Without buttons; None: nobody only looks."""


@contextlib.asynccontextmanager
async def _page(place: _Place) -> AsyncIterator[_Servers]:
    """Serve a page behind its gate, while it is wanted. Raises ``GatewayError`` without the extra."""
    require_package("viser")
    from gateway.viewer.gate import Door, Gate
    from gateway.viewer.inner_page import served_behind_gate

    gate_pass = AccessToken(secrets.token_urlsafe(32))
    with contextlib.ExitStack() as pages:
        server = pages.enter_context(served_behind_gate(gate_pass))
        looking = None if place.looking is None else pages.enter_context(served_behind_gate(gate_pass))
        door = Door(place.token, looking=place.looking)
        looking_port = None if looking is None else looking.get_port()
        async with Gate(place.host, place.port, server.get_port(), door, looking_port, gate_pass):
            shown = "/?token=… (the token's own text)" if place.token is not None else ""
            typer.echo(f"live page: http://{place.host}:{place.port}{shown}")
            yield _Servers(server, looking)


async def _serve_live(
    settings: MqttSettings, gateway: str, place: _Place, waits: bool, muscles_kg: float | None
) -> None:
    """Show poses as they come. Raises ``BrokerUnreachableError`` without a broker, unless ``waits``."""
    from gateway.outputs.subscriber import PoseSubscriber

    require_package("viser")
    if not waits:
        # The address of a page that ends at once for want of a broker would only mislead.
        async with PoseSubscriber(settings, gateway):
            pass
    async with _page(place) as servers:
        from gateway.viewer.live import LiveViewer

        viewers = [LiveViewer(servers.writing, settings, gateway, muscles_kg)]
        if servers.looking is not None:
            viewers.append(LiveViewer(servers.looking, settings, gateway, muscles_kg, may_write=False))
        await asyncio.gather(*(viewer.run(waits) for viewer in viewers))


async def _serve_recording(
    recording: Path, compare: Path | None, place: _Place, muscles_kg: float | None
) -> None:
    from gateway.recording import open_recording

    with progress_bar(f"reading {recording.name}") as progress:
        opened = open_recording(recording)
        arrays = opened.skeleton_arrays(progress)
    compared = None
    if compare is not None:
        with progress_bar(f"reading {compare.name}") as progress:
            compared = open_recording(compare).skeleton_arrays(progress)
    async with _page(place) as servers:
        from gateway.viewer.marker_points import recorded_markers
        from gateway.viewer.playback import Playback

        markers = recorded_markers(opened, arrays)
        await asyncio.gather(
            *(
                Playback(server, arrays, recording.stem, markers, muscles_kg, compared).run()
                for server in filter(None, servers)
            )
        )
