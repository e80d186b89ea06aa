"""``mocap-gateway replay``: a recording through the gateway again, over MQTT or recomputed at once."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.replay_link import ReplayLink, speed_from
from gateway.cli.options import AsJson, Embedded
from gateway.cli.preparing import make_ready
from gateway.cli.run import until_signal
from gateway.cli.solving_options import SolvedOtherwise, with_solving
from gateway.cli.terminal import progress_bar
from gateway.errors import GatewayError, SettingsError
from gateway.settings import GatewaySettings, load_gateway_settings
from gateway.support.processor import NATIVE

if TYPE_CHECKING:
    from devices.links.marker_file_link import MarkerFileLink
    from gateway.recording import Recording
    from gateway.recording.solving import SolvingSetup
    from gateway.service.service import Service


QUEUE = 512
"""Poses that may wait for the broker; reading goes on while no more than half of them do."""
_POLL_S = 0.002
_REFRESH_S = 0.1


def replay_live(
    recording: Recording, setup: SolvingSetup, speed: float | None, *, embedded: bool, as_json: bool
) -> None:
    """Play until the end or Ctrl-C. Waits for the broker first; at full speed for its subscribers too."""
    from gateway.recording.solving import with_recorded_table
    from gateway.service.service import Service

    settings = for_playing(setup.settings, embedded=embedded)
    # A recording that is played must not record itself.
    kept = settings.recording.model_copy(update={"at_start": False})
    settings = settings.model_copy(update={"recording": kept})
    link = ReplayLink(recording.meta.path, speed=speed)
    with with_recorded_table(recording, settings) as complete:
        service = Service(complete, setup.suit, [link])

    link.hold = Brake(service, is_paced=speed is not None).hold
    typer.echo(f"playing to {settings.mqtt.base_topic}/{settings.gateway}/pose; Ctrl-C ends", err=True)
    asyncio.run(play(service, link, as_json))
    print_outcome(service, as_json)


def for_playing(settings: GatewaySettings, *, embedded: bool) -> GatewaySettings:
    """Return settings with a queue for poses that come in bursts. embedded: with a broker of our own."""
    # At full speed a short queue would drop what a live suit never would.
    changes: dict[str, object] = {"queue_length": max(settings.mqtt.queue_length, QUEUE)}
    if embedded:
        changes.update(broker="embedded", host="127.0.0.1")
    return settings.model_copy(update={"mqtt": settings.mqtt.model_copy(update=changes)})


def print_outcome(service: Service, as_json: bool) -> None:
    """Print how many poses were made, published and dropped."""
    counters = service.mqtt.counters
    outcome = {"poses": service.pipeline.skeleton_frames, "published": counters.published}
    outcome["dropped"] = counters.dropped
    if as_json:
        typer.echo(json.dumps(outcome))
    else:
        typer.echo("{poses} poses, {published} published, {dropped} dropped".format(**outcome))


class Brake:
    """Holds the reading up until the broker is there, and at full speed while it has fallen behind."""

    def __init__(self, service: Service, *, is_paced: bool) -> None:
        self._mqtt = service.mqtt
        self._is_paced = is_paced
        self._has_begun = False

    async def hold(self) -> None:
        """Return when reading may go on."""
        await asyncio.sleep(0)
        while not self._may_go_on():  # noqa: ASYNC110 - two conditions of others, neither an event
            await asyncio.sleep(_POLL_S)
        self._has_begun = True

    def _may_go_on(self) -> bool:
        if self._is_paced and self._has_begun:
            return True
        return self._mqtt.is_connected and self._mqtt.counters.queued <= QUEUE // 2


async def play(service: Service, link: ReplayLink | MarkerFileLink, as_json: bool) -> None:
    """Run the service until the link has come to its end, with a progress bar."""
    running = asyncio.ensure_future(until_signal(service))
    with (
        progress_bar("playing", is_shown=not as_json) as progress,
        contextlib.suppress(asyncio.CancelledError),
    ):
        while not running.done():
            progress(link.position, link.size)
            await asyncio.wait({running}, timeout=_REFRESH_S)
        await running


@with_solving
def replay(
    wanted: SolvedOtherwise,
    file: Annotated[Path, typer.Argument(help="Recording; later parts of its session follow by themselves.")],
    speed: Annotated[
        str, typer.Option(help="1: as recorded, 2: twice as fast, …, max: as fast as it goes.")
    ] = "1",
    offline: Annotated[bool, typer.Option("--offline", help="Recompute without a broker.")] = False,
    verified: Annotated[
        bool, typer.Option("--verify", help="Recompute, and compare with the recorded poses byte by byte.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The new recording; given alone: solve as recorded."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Broker and gateway name from this file instead.")
    ] = None,
    embedded: Embedded = False,
    as_json: AsJson = False,
) -> None:
    """Play a recording: over MQTT like a live suit, or recomputed at once.

    With --with, --reconstructor, --delay-ms or --smooth it is solved anew, into a new recording.
    With --verify it ends with 1 unless every recorded pose comes out again, bit for bit: it does with the
    same version, configuration and libraries, for recordings that began with the gateway.
    """
    from gateway.recording import open_recording

    factor = speed_of(speed)
    if verified and (wanted.is_asked_for or output):
        raise GatewayError(
            "--verify compares with the recorded poses: leave out --with, --reconstructor, --delay-ms, "
            "--smooth, --output"
        )
    recording = open_recording(file)
    setup = _setup(recording, wanted, config)
    make_ready(setup.settings.reconstructor)
    if verified:
        _verify(recording, as_json)
    elif wanted.is_asked_for or output:
        _solve(recording, setup, output or wanted.target(file), as_json)
    elif offline:
        _solve(recording, setup, None, as_json)
    else:
        _note_others(recording, setup)
        replay_live(recording, setup, factor, embedded=embedded, as_json=as_json)
    if recording.defect is not None:
        typer.echo(f"note: {recording.defect}", err=True)


def _note_others(recording: Recording, setup: SolvingSetup) -> None:
    """Say where the poses in the file are not those that are played."""
    if setup.smoothed:
        typer.echo("note: poses are played as they came live; the smoothed ones stand in the file", err=True)
    if recording.meta.solved_by:
        typer.echo(
            f"note: poses are played as {setup.settings.reconstructor} makes them; those of "
            f"{recording.meta.solved_by} stand in the file",
            err=True,
        )


def _setup(recording: Recording, wanted: SolvedOtherwise, config: Path | None) -> SolvingSetup:
    """Return what to solve with: as recorded, but for what was asked otherwise."""
    from gateway.body.rig import load_rig
    from gateway.recording.solving import SolvingSetup

    given = None if config is None else load_gateway_settings(config)
    meta = recording.meta
    if not meta.has_suit and given is None:
        raise SettingsError(
            f"{meta.path} tells no suit (it is of a memory card, or imported): name a configuration, "
            "-c my.yaml"
        )
    # The recorded suit is the true one; a configuration only says where to publish, and fills in what is
    # absent.
    settings = meta.settings if meta.has_suit or given is None else given
    if given is not None:
        settings = settings.model_copy(update={"mqtt": given.mqtt, "gateway": given.gateway})
    settings = settings.solved_by(wanted.reconstructor, wanted.delay_ms)
    rig = wanted.with_rig
    if rig is not None:
        settings = settings.model_copy(update={"rig": rig})
    suit = load_rig(rig) if rig else meta.suit if meta.has_suit else load_rig(settings.rig, config)
    return SolvingSetup(suit, settings, meta.smoothed if wanted.smooth is None else wanted.smooth)


def speed_of(text: str) -> float | None:
    """Return a factor; None for as fast as possible. Raises ``GatewayError``."""
    try:
        return speed_from(text)
    except ValueError as error:
        raise GatewayError(f"--speed {text}: {error}") from None


def _verify(recording: Recording, as_json: bool) -> None:
    from gateway.recording.solving import verify

    with progress_bar("verifying", is_shown=not as_json) as progress:
        found = verify(recording, progress)
    if as_json:
        outcome = {
            "identical": found.is_identical,
            "compared": found.compared,
            "difference": found.difference,
        }
        typer.echo(json.dumps(outcome))
    elif found.is_identical:
        cut = f"; {found.not_recorded} more at its cut-off end" if found.not_recorded else ""
        typer.echo(f"identical: {found.compared} poses recomputed, every bit as recorded{cut}")
    else:
        typer.echo(f"different: {found.difference}")
        for reason in _reasons(recording):
            typer.echo(f"  {reason}")
    # A script reads the exit code, whatever was printed.
    if not found.is_identical:
        raise typer.Exit(1)


def _reasons(recording: Recording) -> list[str]:
    """Return what may have made the difference."""
    from gateway.recording.snapshot import host

    reasons = []
    if not recording.meta.from_start:
        reasons.append("the recording began while the gateway was running: its filters had started before")
    if damaged := sum(file.damaged_chunks for file in recording.parts.files):
        reasons.append(f"damaged pieces of the recording are missing, {damaged} up to there")
    was, now = recording.meta.host, host()
    keys = ["gateway", "python", "libraries", "machine", "instructions"]
    if was.get("instructions", NATIVE) == now["instructions"] == NATIVE:
        keys.append("processor")  # which decides them then
    reasons += [
        f"recorded with {key} {was.get(key)}, now {now[key]}" for key in keys if was.get(key) != now[key]
    ]
    return reasons


def _solve(recording: Recording, setup: SolvingSetup, target: Path | None, as_json: bool) -> None:
    from gateway.recording.solving import solve, write_solved

    first_ns = last_ns = frames = 0
    begun = 0.0
    with progress_bar("solving", is_shown=not as_json) as bar:

        def report(done: int, total: int) -> None:
            nonlocal begun
            begun = begun or time.perf_counter()  # the preparations are over
            bar(done, total)

        if target is not None:
            frames = write_solved(recording, target, setup, report)
        else:
            for frame in solve(recording, setup, report):
                first_ns, last_ns, frames = first_ns or frame.time_ns, frame.time_ns, frames + 1
    elapsed_s = time.perf_counter() - begun
    outcome = {
        "poses": frames,
        "elapsed_s": round(elapsed_s, 3),
        "output": None if target is None else str(target),
    }
    if target is None:
        outcome["x_realtime"] = round((last_ns - first_ns) * 1e-9 / elapsed_s, 1)
    if as_json:
        typer.echo(json.dumps(outcome))
    elif target is None:
        typer.echo(f"{frames} poses in {elapsed_s:.1f} s, {outcome['x_realtime']:g} × real time")
    else:
        typer.echo(
            f"{target}: {frames} poses; compare them with `mocap-gateway compare --same-session "
            f"{recording.meta.path} {target}`"
        )
    if not frames:
        ids = ", ".join(map(str, setup.suit.module_ids))
        wanted = f"has it samples of the rig's modules ({ids})" if ids else "has it samples"
        raise GatewayError(f"{recording.meta.path} gives no pose: {wanted}? `mocap-gateway info` counts them")
