"""``mocap-gateway replay``: a recording through the gateway again, over MQTT or recomputed at once."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.replay_link import ReplayLink
from gateway.cli.preparing import make_ready
from gateway.cli.run import until_signal
from gateway.cli.terminal import progress_bar
from gateway.errors import GatewayError, SettingsError
from gateway.settings import MAX_DELAY_MS, load_gateway_settings
from gateway.support.processor import NATIVE

if TYPE_CHECKING:
    from devices.marker_file_link import MarkerFileLink
    from gateway.recording import Recording
    from gateway.recording.solving import Source
    from gateway.service.service import Service


QUEUE = 512
"""Poses that may wait for the broker; reading goes on while no more than half of them do."""
_POLL_S = 0.002
_REFRESH_S = 0.1


def replay_live(
    recording: Recording, source: Source, speed: float | None, *, embedded: bool, as_json: bool
) -> None:
    """Play until the end or Ctrl-C. Waits for the broker first; at full speed for its subscribers too."""
    from gateway.recording.solving import with_recorded_table
    from gateway.service.service import Service

    mqtt = source.settings.mqtt
    # At full speed poses come in bursts: a short queue would drop what a live suit never would.
    changes: dict[str, object] = {"queue_length": max(mqtt.queue_length, QUEUE)}
    if embedded:
        # A recording that is played must not record itself.
        changes.update(broker="embedded", host="127.0.0.1")
    kept = source.settings.recording.model_copy(update={"at_start": False})
    settings = source.settings.model_copy(update={"mqtt": mqtt.model_copy(update=changes), "recording": kept})
    link = ReplayLink(recording.meta.path, speed=speed)
    with with_recorded_table(recording, settings) as complete:
        service = Service(complete, source.suit, [link])

    link.hold = Brake(service, is_paced=speed is not None).hold
    typer.echo(f"playing to {mqtt.base_topic}/{settings.gateway}/pose; Ctrl-C ends", err=True)
    asyncio.run(play(service, link, as_json))
    print_outcome(service, as_json)


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
    with progress_bar("playing", is_shown=not as_json) as progress, contextlib.suppress(asyncio.CancelledError):
        while not running.done():
            progress(link.position, link.size)
            await asyncio.wait({running}, timeout=_REFRESH_S)
        await running


def replay(
    file: Annotated[Path, typer.Argument(help="Recording; later parts of its session follow by themselves.")],
    speed: Annotated[
        str, typer.Option(help="1: as recorded, 2: twice as fast, …, max: as fast as it goes.")
    ] = "1",
    offline: Annotated[bool, typer.Option("--offline", help="Recompute without a broker.")] = False,
    verified: Annotated[
        bool, typer.Option("--verify", help="Recompute, and compare with the recorded poses byte by byte.")
    ] = False,
    with_rig: Annotated[
        str | None,
        typer.Option(
            "--with", metavar="RIG", help="Solve with this rig (file or name), write a new recording."
        ),
    ] = None,
    reconstructor: Annotated[
        str | None, typer.Option(help="Solve with this method, write a new recording.")
    ] = None,
    delay_ms: Annotated[
        float | None,
        typer.Option(min=0, max=MAX_DELAY_MS, help="For gyro_free: poses come so much later, and better."),
    ] = None,
    smooth: Annotated[
        bool | None,
        typer.Option(help="Solve forward and backward: more accurate, write a new recording."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="The new recording; given alone: solve as recorded.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Broker and gateway name from this file instead.")
    ] = None,
    embedded: Annotated[bool, typer.Option("--embedded", help="Publish on a broker of our own.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")] = False,
) -> None:
    """Play a recording: over MQTT like a live suit, or recomputed at once.

    With --verify it ends with 1 unless every recorded pose comes out again, bit for bit: it does with the
    same version, configuration and libraries, for recordings that began with the gateway.
    """
    from gateway.recording import open_recording

    recording = open_recording(file)
    source = _source(recording, with_rig, reconstructor, config, smooth, delay_ms)
    make_ready(source.settings.reconstructor)
    is_other = bool(with_rig or reconstructor or delay_ms is not None or smooth is not None)
    if verified:
        if is_other:
            raise GatewayError(
                "--verify compares with the recorded poses: leave out --with, --reconstructor, --delay-ms, "
                "--smooth"
            )
        _verify(recording, as_json)
    elif is_other or output:
        target = output or _target(file, with_rig, reconstructor, smooth, delay_ms)
        _solve(recording, source, target, as_json)
    elif offline:
        _solve(recording, source, None, as_json)
    else:
        _note_others(recording, source)
        replay_live(recording, source, speed_of(speed), embedded=embedded, as_json=as_json)
    if recording.defect is not None:
        typer.echo(f"note: {recording.defect}", err=True)


def _note_others(recording: Recording, source: Source) -> None:
    """Say where the poses in the file are not those that are played."""
    if source.smoothed:
        typer.echo("note: poses are played as they came live; the smoothed ones stand in the file", err=True)
    if recording.meta.solved_by:
        typer.echo(
            f"note: poses are played as {source.settings.reconstructor} makes them; those of "
            f"{recording.meta.solved_by} stand in the file",
            err=True,
        )


def _source(
    recording: Recording,
    with_rig: str | None,
    reconstructor: str | None,
    config: Path | None,
    smooth: bool | None = None,
    delay_ms: float | None = None,
) -> Source:
    """Return what to solve with: as recorded, but for what was asked otherwise."""
    from gateway.body.rig import load_rig
    from gateway.recording.solving import Source

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
    settings = settings.solved_by(reconstructor, delay_ms)
    if with_rig is not None:
        settings = settings.model_copy(update={"rig": with_rig})
    suit = load_rig(with_rig) if with_rig else meta.suit if meta.has_suit else load_rig(settings.rig, config)
    return Source(suit, settings, meta.smoothed if smooth is None else smooth)


def _target(
    file: Path, with_rig: str | None, reconstructor: str | None, smooth: bool | None, delay_ms: float | None
) -> Path:
    rig, way = Path(with_rig).stem if with_rig else None, {True: "smoothed", False: "forward", None: None}
    late = None if delay_ms is None else f"{delay_ms:g}ms"
    marks = [mark for mark in (rig, reconstructor, late, way[smooth]) if mark]
    return file.with_name(f"{file.stem}_{'_'.join(marks)}.mcap")


def speed_of(text: str) -> float | None:
    """Return a factor; None for as fast as possible. Raises ``GatewayError``."""
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0 < speed < float("inf"):
        raise GatewayError(f"--speed {text}: a number above 0, or max, is needed")
    return speed


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
    was, now = recording.meta.host, host()
    keys = ["gateway", "python", "libraries", "machine", "instructions"]
    if was.get("instructions", NATIVE) == now["instructions"] == NATIVE:
        keys.append("processor")  # which decides them then
    reasons += [
        f"recorded with {key} {was.get(key)}, now {now[key]}" for key in keys if was.get(key) != now[key]
    ]
    return reasons


def _solve(recording: Recording, source: Source, target: Path | None, as_json: bool) -> None:
    from gateway.recording.solving import solve, write_solved

    first_ns = last_ns = frames = 0
    begun = 0.0
    with progress_bar("solving", is_shown=not as_json) as bar:

        def report(done: int, total: int) -> None:
            nonlocal begun
            begun = begun or time.perf_counter()  # the preparations are over
            bar(done, total)

        if target is not None:
            frames = write_solved(recording, target, source, report)
        else:
            for frame in solve(recording, source, report):
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
