"""``mocap-gateway calibrate body``: how modules sit on the wearer, step by step."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from devices.calibration_script import PERIOD_S, begin_of_script, timetable
from devices.link import Link, gateway_time_ns
from devices.links.reconnect import kept_open
from devices.replay_link import contents_of
from gateway.body.skeleton import WornSuit
from gateway.calibration.procedure import Step, StepKind
from gateway.cli.options import link_of, refuse_absent_folder
from gateway.cli.preparing import stand_in
from gateway.errors import GatewayError
from gateway.settings import GatewaySettings, load_gateway_settings

if TYPE_CHECKING:
    from gateway.calibration.body_result import BodyResult
    from gateway.calibration.body_session import BodySession, Liveliness
    from gateway.pipeline import Pipeline


_COLOURS = {"good": "green", "fair": "yellow", "poor": "red"}
_BAR = 20
_FULL_BAR = np.radians(120.0)


def live_table(session: BodySession, step: Step | None, live: Sequence[Liveliness]) -> Table:
    """Return a bar for every module: how fast it turns, and whether that is wanted now."""
    from gateway.calibration.control import STILL

    wants_rest = step is None or step.kind is StepKind.POSE
    table = Table("module", "segment", "turning", "")
    for (module, segment), one in zip(modules_of(session), live, strict=True):
        is_still = one.turning < STILL
        if not one.is_received:
            state, colour = "silent", "red"
        elif is_still:
            state, colour = "still", "green" if wants_rest else "white"
        else:
            state, colour = "moving", "red" if wants_rest else "green"
        full = min(round(_BAR * one.turning / _FULL_BAR), _BAR) if one.is_received else 0
        bar = Text("█" * full + "░" * (_BAR - full) + f" {np.degrees(one.turning):4.0f} °/s", colour)
        table.add_row(str(module), segment.replace("_", " "), bar, Text(state, colour))
    return table


def modules_of(session: BodySession) -> list[tuple[int, str]]:
    """Return module id and segment, in the order of the rig."""
    suit = session.suit
    segments = {
        int(row): name for row, name in zip(suit.module_of_segment, suit.skeleton.segment_names, strict=True)
    }
    return [(module, segments[row]) for row, module in enumerate(suit.module_ids)]


def result_table(result: BodyResult) -> Table:
    """Return a line a module: how good, how certain, and why not better."""
    table = Table("module", "segment", "quality", "orientation ±", "place ±", "why")
    for one in result.modules:
        quality = one.quality
        table.add_row(
            str(one.module),
            one.segment.replace("_", " "),
            Text(f"{quality.verdict} {quality.score:.2f}", _COLOURS[quality.verdict]),
            f"{np.degrees(one.rotation_sigma):.1f}°",
            f"{100 * one.position_sigma:.1f} cm",
            _reasons(quality.reasons),
        )
    return table


def _reasons(reasons: Sequence[str]) -> str:
    """Return the worst one; the others are counted, and shown by ``--json``."""
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    return reasons[0] + more if reasons else ""


_REFRESH_S = 0.1
_SILENT_S = 10.0
_PATIENCE = {"max_wait_ms": 1000.0, "max_gap_ms": 200.0}
"""Of the assembly: nobody waits for these frames, so that late samples may come."""
_SOLVING = (
    "finding how the {} modules sit: all steps are weighed against each other at once, which takes some "
    "seconds, on a slow machine half a minute"
)
_NOT_ALIVE = "no module of the rig was heard for {:.0f} s: are they switched on, and is the link right?"


def body(
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Configuration: links and rig.")
    ] = None,
    link: Annotated[str | None, typer.Option(help="Port or URL of the suit, with --rig.")] = None,
    rig: Annotated[str | None, typer.Option(help="Rig: a shipped one or a file.")] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Rig file to write [that of the rig; of a shipped one <rig>.worn.yaml beside the config]",
        ),
    ] = None,
    steps: Annotated[str | None, typer.Option(help="Only these steps, separated by commas.")] = None,
    countdown: Annotated[float, typer.Option(min=0, max=30, help="Time to get ready, s.")] = 3.0,
    field: Annotated[
        bool, typer.Option(help="Headings from magnetometers; --no-field: from movements alone.")
    ] = True,
    emulated: Annotated[
        bool,
        typer.Option("--emulated", help="The wearer is `emulate --motion calibration`: keep to his time."),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Ask nothing: take what is not poor.")] = False,
    poor: Annotated[bool, typer.Option("--poor", help="Take results of poor quality too.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON; asks nothing.")] = False,
) -> None:
    """Find out how every module sits: poses, a few movements, a score for each module.

    The wearer may face any direction, and modules may be strapped on anyhow. What was not good enough can be
    done again, for all modules or for one. The earlier rig file is kept: see `calibrate history`.
    """
    from gateway.body.rig import load_rig
    from gateway.calibration.body_session import BodySession
    from gateway.calibration.kept_rig import KeptRig, rig_advice
    from gateway.calibration.mounting import write_mounted_rig

    settings = _settings(config, link, rig)
    kept_rig = KeptRig(settings.rig, config)
    source, target = kept_rig.configured, output or kept_rig.target
    refuse_absent_folder(target)

    suit = load_rig(settings.rig, config)
    session = BodySession(suit, uses_field=field)
    plan = [session.step(name.strip()) for name in steps.split(",")] if steps else list(session.steps)
    guide = _Guide(session, plan, countdown, emulated, asks=not (yes or as_json or not sys.stdin.isatty()))
    console = Console(stderr=as_json, quiet=as_json)

    result = asyncio.run(_calibrate(settings, suit, guide, console))
    if as_json:
        typer.echo(json.dumps(result.as_json()))
    taken = result.accepted(with_poor=poor)
    if not taken:
        raise GatewayError("no module could be calibrated well enough: nothing was written; see the reasons")
    kept = write_mounted_rig(source, target, taken)
    typer.echo(rig_advice(target, config), err=as_json)
    if kept is not None:
        typer.echo(f"the earlier one is kept as {kept}", err=as_json)
    raise typer.Exit(0 if len(taken) == len(result.modules) else 1)


def versions(rig: Annotated[Path, typer.Argument(help="Rig file that `calibrate body` wrote.")]) -> None:
    """List earlier versions of a rig file, the newest first."""
    from gateway.calibration.mounting import history

    earlier = history(rig)
    if not (earlier or rig.exists()):
        raise GatewayError(f"{rig} cannot be read: no such file")
    for path in earlier:
        typer.echo(path.stem)
    if not earlier:
        typer.echo(f"no earlier version of {rig} is kept", err=True)


def put_back(
    rig: Annotated[Path, typer.Argument(help="Rig file that `calibrate body` wrote.")],
    version: Annotated[str | None, typer.Option(help="As `calibrate history` lists it [the newest]")] = None,
) -> None:
    """Put an earlier version of a rig file back; what is there now is kept as well."""
    from gateway.calibration.mounting import restore

    typer.echo(f"{rig} is again as of {restore(rig, version).stem}")


def _settings(config: Path | None, link: str | None, rig: str | None) -> GatewaySettings:
    if config is not None:
        settings = load_gateway_settings(config)
        return settings if rig is None else settings.model_copy(update={"rig": rig})
    if link is None or rig is None:
        raise GatewayError("where is the suit? give -c CONFIG, or --link PORT --rig RIG")
    return GatewaySettings(links=[link_of(link)], rig=rig)


async def _calibrate(
    settings: GatewaySettings, suit: WornSuit, guide: _Guide, console: Console
) -> BodyResult:
    """Listen on all links while the wearer is guided."""
    from devices.endpoints import link_from_url
    from gateway.pipeline import Pipeline

    patient = settings.assembly.model_copy(update=_PATIENCE)
    needing_little = stand_in(settings, partial(console.print, style="dim"))  # poses are not looked at
    pipeline = Pipeline.from_settings(needing_little.model_copy(update={"assembly": patient}), suit)
    pipeline.module_stage.on_frame = guide.session.add
    worn_links = [one for one in settings.links if one.carries != "heat_maps"]
    readers = [
        asyncio.create_task(_read(kept_open(link_from_url(one.url, name=one.name)), one.carries, pipeline))
        for one in worn_links
    ]
    try:
        return await guide.run(console)
    finally:
        for reader in readers:
            reader.cancel()
        await asyncio.gather(*readers, return_exceptions=True)


async def _read(link: Link, carries: str, pipeline: Pipeline) -> None:
    await link.open()
    try:
        for name, content in contents_of(link, carries).items():
            pipeline.add_link(name, content)
        async for item in link:
            pipeline.take(item)
    finally:
        await link.close()


class _Guide:
    """Leads the wearer through the steps, and through those to be done again."""

    def __init__(
        self, session: BodySession, plan: list[Step], countdown: float, is_emulated: bool, *, asks: bool
    ) -> None:
        self.session = session
        self._plan = plan
        self._countdown = countdown
        self._is_emulated = is_emulated
        self._asks = asks
        self._begin_ns = 0

    async def run(self, console: Console) -> BodyResult:
        """Guide through all steps.

        Raises ``GatewayError`` when no module is heard, or nothing can be solved.
        """
        await self._until_received(console)
        for step in self._plan:
            await self._do(step, console)
        while True:
            n_modules = len(self.session.suit.module_ids)

            with console.status(_SOLVING.format(n_modules)):
                # Better no new rig than one with poor values that look measured.
                result = await asyncio.to_thread(self.session.result)
            console.print(result_table(result))
            again = await asyncio.to_thread(self._ask, console) if self._asks else None
            if again is None:
                return result
            step, segments = again
            await self._do(step, console, segments)

    async def _until_received(self, console: Console) -> None:
        begin_ns = gateway_time_ns()
        with console.status("waiting for the modules"):
            while not self.session.now_ns:
                if gateway_time_ns() - begin_ns > _SILENT_S * 1e9 and not self._is_emulated:
                    # Solving takes seconds, in a thread: samples keep being read meanwhile.
                    raise GatewayError(_NOT_ALIVE.format(_SILENT_S))
                await asyncio.sleep(_REFRESH_S)
        self._begin_ns = begin_of_script(gateway_time_ns()) - round(PERIOD_S * 1e9)

    async def _do(self, step: Step, console: Console, segments: list[str] | None = None) -> None:
        """Count down, record; the bars show at once what every module does."""
        begin_ns, end_ns = self._times(step)
        with Live(console=console, auto_refresh=False, transient=True) as live:
            await self._show(live, step, begin_ns, is_recording=False)
            self.session.begin(step.name, segments)
            await self._show(live, step, end_ns, is_recording=True)
            self.session.end()
        console.print(f"[green]done[/green]  {step.name}: {step.instruction}", highlight=False)

    def _times(self, step: Step) -> tuple[int, int]:
        """Gateway times at which the step is recorded."""
        if self._is_emulated:
            begin_s, end_s = timetable()[step.name]
            offset_ns = self._begin_ns
            # The emulated wearer repeats the script for ever: the step is recorded at its next turn.
            while offset_ns + begin_s * 1e9 < gateway_time_ns():
                offset_ns = begin_of_script(offset_ns + 1)
            return offset_ns + round(begin_s * 1e9), offset_ns + round(end_s * 1e9)
        begin_ns = gateway_time_ns() + round(self._countdown * 1e9)
        return begin_ns, begin_ns + round(step.seconds * 1e9)

    async def _show(self, live: Live, step: Step, until_ns: int, *, is_recording: bool) -> None:
        while (left_s := (until_ns - gateway_time_ns()) * 1e-9) > 0:
            head = Text(f"{step.name}: {step.instruction}", "bold")
            clock = Text(f"recording, {left_s:.0f} s left", "bold red")
            if not is_recording:
                clock = Text(f"get ready: {left_s:.0f}", "bold yellow")
            table = live_table(self.session, step if is_recording else None, self.session.live())
            live.update(Group(head, clock, table), refresh=True)
            await asyncio.sleep(min(_REFRESH_S, max(left_s, 0.001)))

    def _ask(self, console: Console) -> tuple[Step, list[str] | None] | None:
        """Accept, or a step to be done again, for all modules or some. Reads the terminal."""
        names = ", ".join(step.name for step in self._plan)
        while True:
            console.print(
                f"Enter: accept. Or a step to do again ({names}), with segments to redo only these: "
                "'n_pose left_shank'",
                highlight=False,
            )
            with contextlib.suppress(EOFError):
                # The end of the input accepts, as an empty line does: a script has no more to say.
                words = input("> ").replace(",", " ").split()
                if words:
                    try:
                        step = self.session.step(words[0])
                        known = {segment for _, segment in modules_of(self.session)}
                        if unknown := [word for word in words[1:] if word not in known]:
                            raise GatewayError(f"no module sits on '{unknown[0]}'")
                    except GatewayError as error:
                        console.print(str(error), style="red", markup=False)
                        continue
                    return step, words[1:] or None
            return None
