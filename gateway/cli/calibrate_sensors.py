"""``mocap-gateway calibrate sensors``: biases and ellipsoids of all modules' sensors."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from devices.link import gateway_time_ns
from gateway.body.skeleton import WornSuit, field_dip_deg
from gateway.calibration.sensor_session import (
    REST_S,
    SENSORS,
    Progress,
    Result,
    SensorSession,
    advice_on,
    combined,
    results_as_json,
    usable,
)
from gateway.calibration.sensors import ENOUGH_COVERAGE, EllipsoidResult, GyroscopeResult
from gateway.cli.modules_suit import SuitChoice, with_suit
from gateway.cli.options import ReplaceFiles, link_of, refuse_absent_folder, refuse_existing
from gateway.errors import GatewayError, nearest
from gateway.settings import load_gateway_settings
from gateway.sources.link_settings import LinkSettings
from gateway.support.former_names import current
from gateway.support.settings_files import find_file

if TYPE_CHECKING:
    from gateway.modules.operations import ModuleOperations


_COLOURS = {"good": "green", "fair": "yellow", "poor": "red"}
_BAR = 16
_SIDES_NAMED = 3


def advice(session: SensorSession, progress: Mapping[int, Progress]) -> str:
    """Return what to do next, for the suit as a whole."""
    key, modules = advice_on(session, progress)
    return _ADVICE[key].format(modules=", ".join(map(str, modules)))


_ADVICE = {
    "listen": "waiting for the modules",
    "rest": f"put all modules down and leave them untouched for {REST_S:.0f} s",
    "hold": "hold still for two seconds",
    "other_side": "now turn them to another side, and let them lie there",
    "turn": "turn them slowly about all axes, away from iron, until the bars are full",
    "silent": "waiting for module {modules}",
    "enough": "that is enough",
}


def progress_table(session: SensorSession, progress: Mapping[int, Progress]) -> Table:
    """Return how far every module is."""
    table = Table("module", *session.sensors, "")
    for module, one in progress.items():
        cells = {
            "gyroscope": _amount(one.rest_s, REST_S, f"{one.rest_s:.0f} s at rest"),
            "accelerometer": _positions(one, session.wanted_positions),
            "magnetometer": _bar(one.coverage),
        }
        state = "silent" if not one.samples else "at rest" if one.is_at_rest else "moving"
        done = Text("enough", "green") if session.is_enough(one) else Text(state, "dim")
        table.add_row(str(module), *(cells[sensor] for sensor in session.sensors), done)
    return table


def result_table(found: Mapping[int, Mapping[str, Result | str]]) -> Table:
    """Return what was found, and how good it is."""
    table = Table("module", "sensor", "bias", "spread of the norm", "quality", "why")
    for module, results in found.items():
        # A text in place of a result is the reason why there is none.
        for sensor, result in results.items():
            if isinstance(result, str):
                table.add_row(str(module), sensor, "–", "–", Text("none", "red"), result)
                continue
            quality = result.quality
            verdict = Text(f"{quality.verdict} {quality.score:.2f}", _COLOURS[quality.verdict])
            table.add_row(
                str(module),
                sensor,
                _bias(sensor, result),
                _spread(result),
                verdict,
                "; ".join(quality.reasons),
            )
    return table


def _bias(sensor: str, result: Result) -> str:
    if isinstance(result, GyroscopeResult):
        return "  ".join(f"{value:+.2f}" for value in np.degrees(result.bias)) + " °/s"
    unit = "m/s²" if sensor == "accelerometer" else "µT"
    return "  ".join(f"{value:+.2f}" for value in result.fit.bias) + f" {unit}"


def _spread(result: Result) -> str:
    if not isinstance(result, EllipsoidResult):
        return "–"
    return f"{100 * result.fit.spread_before:.1f} % → {100 * result.fit.spread_after:.2f} %"


def _amount(value: float, wanted: float, text: str) -> Text:
    return Text(text, "green" if value >= wanted else "yellow")


def _positions(one: Progress, wanted: int) -> Text:
    text = f"{one.positions} of {wanted} positions"
    if one.sides_missing and one.positions:
        named = ", ".join(one.sides_missing[:_SIDES_NAMED])
        more = "…" if len(one.sides_missing) > _SIDES_NAMED else ""
        text += f" (up: {named}{more})"
    return _amount(one.positions, wanted, text)


def _bar(share: float) -> Text:
    full = min(round(_BAR * share / ENOUGH_COVERAGE), _BAR)
    colour = "green" if share >= ENOUGH_COVERAGE else "yellow"
    return Text("█" * full + "░" * (_BAR - full) + f" {100 * share:.0f} %", colour)


_REFRESH_S = 0.25
_SILENT_S = 10.0
_SAME_DIP_DEG = 0.5


@with_suit
def sensors(
    suit: SuitChoice,
    only: Annotated[
        str | None, typer.Option(help=f"Some of {', '.join(SENSORS)}, separated by commas. Default: all.")
    ] = None,
    modules: Annotated[
        str | None, typer.Option(help="Ids of some modules, separated by commas. Default: all of the rig.")
    ] = None,
    cube: Annotated[
        bool, typer.Option("--cube", help="Accelerometers lie on the six sides of a levelled cube.")
    ] = False,
    seconds: Annotated[
        float, typer.Option(min=1, max=3600, help="End after so long, with what there is then.")
    ] = 600.0,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Rig file to write [<rig>.calibrated.yaml]")
    ] = None,
    force: ReplaceFiles = False,
    flash: Annotated[
        bool, typer.Option("--flash", help="Write to the modules, not to a rig file; needs --allow-writes.")
    ] = False,
    poor: Annotated[bool, typer.Option("--poor", help="Keep results of poor quality too.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the results as JSON; no live table.")
    ] = False,
) -> None:
    """Measure the sensors' own errors: modules in a box, let it lie, put it on its sides, turn it about.

    Lying still gives the gyroscopes' bias, lying still in twelve positions (each side, and askew) the
    accelerometers' scales, turning in all directions the magnetometers' hard and soft iron, away from iron.
    The order does not matter; it ends when every module has shown enough. Ctrl-C takes what there is.
    """
    from gateway.body.rig import load_rig
    from gateway.calibration.kept_rig import rig_advice
    from gateway.calibration.rig_file import write_calibrated_rig

    rig, links = _rig_and_links(suit)
    source = find_file(rig, "rigs", suit.config)
    target = _target(source, suit, output, force, flash)
    worn = load_rig(rig, suit.config)
    session = _session(worn, modules, only, has_cube=cube)

    found = asyncio.run(_calibrate(suit, links, worn, session, seconds, flash, poor, as_json))
    kept = {module: usable(results, poor) for module, results in found.items()}
    if as_json:
        typer.echo(json.dumps(results_as_json(found)))
    else:
        Console().print(result_table(found))

    # Sensors without a usable result keep the calibration that the rig has.
    calibrations = {m: combined(r, worn.calibrations.get(m)) for m, r in kept.items() if r}
    dip_deg = session.dip_deg({m: each for m, each in calibrations.items() if "magnetometer" in kept[m]})
    if dip_deg is not None:
        typer.echo(_about_the_field(dip_deg, worn, is_written=target is not None), err=as_json)
    if target is not None and calibrations:
        write_calibrated_rig(source, target, calibrations, dip_deg=dip_deg)
        typer.echo(rig_advice(target, suit.config), err=as_json)
    raise typer.Exit(0 if all(len(r) == len(session.sensors) for r in kept.values()) else 1)


def _session(worn: WornSuit, modules: str | None, only: str | None, *, has_cube: bool) -> SensorSession:
    """Return a session that has seen nothing. Raises ``GatewayError`` for unknown modules or sensors."""
    return SensorSession(
        _chosen_modules(worn, modules),
        gravity=-float(worn.gravity[2]),
        field_ut=float(sum(worn.magnetic_field**2) ** 0.5),
        sensors=_chosen_sensors(only),
        has_levelled_cube=has_cube,
    )


def _about_the_field(dip_deg: float, worn: WornSuit, *, is_written: bool) -> str:
    """Return a line about the local field: who takes headings from it should know it."""
    had = field_dip_deg(worn.magnetic_field)
    found = f"the field points {dip_deg:.1f}° below the horizontal here"
    if abs(dip_deg - had) < _SAME_DIP_DEG:
        return f"{found}, as the rig has it"
    remedy = "corrected" if is_written else f"write 'magnetic_field: {{dip_deg: {dip_deg:.1f}}}' to its world"
    return f"{found}; the rig has {had:.1f}°: {remedy}"


async def _calibrate(
    suit: SuitChoice,
    links: Sequence[LinkSettings],
    worn: WornSuit,
    session: SensorSession,
    seconds: float,
    flash: bool,
    poor: bool,
    is_quiet: bool,
) -> dict[int, dict[str, Result | str]]:
    """Listen until it is enough; write to the modules where that is wanted."""
    from gateway.calibration.sensor_control import flash as flash_to
    from gateway.modules.journal import Journal, default_journal_path
    from gateway.modules.session import suit_session

    journal = Journal(default_journal_path())
    async with suit_session(links, worn, allow_writes=suit.allow_writes, journal=journal) as operations:
        await _listen(operations, session, seconds, is_quiet)
        found = {module: session.results(module) for module in session.modules}
        if flash:
            for module, results in found.items():
                if kept := usable(results, poor):
                    await flash_to(operations, module, kept)
    return found


async def _listen(
    operations: ModuleOperations, session: SensorSession, seconds: float, is_quiet: bool
) -> None:
    from gateway.calibration.sensor_feed import fed

    stop = asyncio.Event()
    # Ctrl-C ends the collecting alone: what was collected until then is solved.
    asyncio.get_running_loop().add_signal_handler(signal.SIGINT, stop.set)
    try:
        with fed(session, operations.stream, operations.makers):
            await _show_until_done(session, seconds, stop, is_quiet)
    finally:
        asyncio.get_running_loop().remove_signal_handler(signal.SIGINT)


async def _show_until_done(
    session: SensorSession, seconds: float, stop: asyncio.Event, is_quiet: bool
) -> None:
    begin_ns = gateway_time_ns()
    console = Console(stderr=True, quiet=is_quiet)
    with Live(console=console, auto_refresh=False, transient=True) as live:
        while not stop.is_set() and (gateway_time_ns() - begin_ns) * 1e-9 < seconds:
            progress = {module: one.progress() for module, one in session.modules.items()}
            head = Text(advice(session, progress), "bold")
            live.update(Group(head, progress_table(session, progress)), refresh=True)
            if all(session.is_enough(one) for one in progress.values()):
                return
            is_late = gateway_time_ns() - begin_ns > _SILENT_S * 1e9
            if is_late and not any(one.samples for one in progress.values()):
                raise GatewayError(
                    f"no module of the rig was heard for {_SILENT_S:.0f} s: are they switched on, and is "
                    "the link right?"
                )
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_REFRESH_S):
                    await stop.wait()


def _rig_and_links(suit: SuitChoice) -> tuple[str, Sequence[LinkSettings]]:
    if suit.mqtt is not None:
        raise GatewayError(
            "calibrate sensors reads the modules itself: stop the running gateway and give -c or --link"
        )
    if suit.link is not None:
        if suit.rig is None:
            raise GatewayError("--link needs --rig: name a shipped rig, such as suit_17, or a rig file")
        return suit.rig, [link_of(suit.link)]
    if suit.config is None:
        raise GatewayError("where is the suit? give -c CONFIG, or --link PORT --rig RIG")
    settings = load_gateway_settings(suit.config)
    return suit.rig or settings.rig, settings.links


def _target(source: Path, suit: SuitChoice, output: Path | None, force: bool, flash: bool) -> Path | None:
    """Return the rig file to write; None when the modules themselves are written to."""
    if flash:
        if not suit.allow_writes:
            raise GatewayError("--flash changes what modules keep: give --allow-writes too")
        return None
    folder = suit.config.parent if suit.config is not None else Path()
    # A file that was calibrated before is named so already.
    target = output or folder / f"{source.stem.removesuffix('.calibrated')}.calibrated.yaml"
    refuse_absent_folder(target)
    refuse_existing(target, force)
    return target


def _chosen_sensors(only: str | None) -> tuple[str, ...]:
    if only is None:
        return SENSORS
    names = tuple(current([name.strip() for name in only.split(",")]))
    for name in names:
        if name not in SENSORS:
            raise GatewayError(f"--only {name}: no such sensor{nearest(name, SENSORS)}")
    return names


def _chosen_modules(worn: WornSuit, chosen: str | None) -> tuple[int, ...]:
    if chosen is None:
        return worn.module_ids
    ids = []
    for text in chosen.split(","):
        if not text.strip().isdecimal() or int(text) not in worn.module_ids:
            known = ", ".join(map(str, worn.module_ids))
            raise GatewayError(f"--modules {text.strip()}: the rig has no such module (it has {known})")
        ids.append(int(text))
    return tuple(ids)
