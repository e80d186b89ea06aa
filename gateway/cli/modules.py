"""``mocap-gateway modules``: list, identify, assign and configure the modules of a suit."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml
from rich.console import Console
from rich.live import Live
from rich.text import Text

from devices.commands.device_backup import parse_unique_id
from gateway.cli.modules_card import card_app
from gateway.cli.modules_conformance import conformance
from gateway.cli.modules_suit import WIDEST, Operations, SuitChoice, modules_screen, run_with_suit, with_suit
from gateway.cli.options import AsJson, ReplaceFiles, refuse_existing
from gateway.cli.terminal import TypedLines, wide_console
from gateway.errors import GatewayError, nearest
from gateway.modules.assignment import Proposal, Wardrobe
from gateway.modules.discovery import EVERYWHERE, by_link, discovered, link_line
from gateway.support.settings_files import load_yaml
from gateway.support.whole_files import write_whole, writing

Wide = Annotated[
    bool, typer.Option("--wide", help="Firmware, gaps, resets and clocks too; takes 150 columns.")
]


@with_suit
def list_modules(
    suit: SuitChoice,
    listen: Annotated[
        float, typer.Option(min=0.5, max=30, help="Seconds to measure rates; clocks (ppm) need some 10.")
    ] = 3.0,
    wide: Wide = False,
    as_json: AsJson = False,
) -> None:
    """List the modules that can be heard. Ends with 1 when two share an id, or a link is not there."""

    async def work(operations: Operations) -> int:
        listed = await operations.perform("list", {"listen_s": listen})
        if as_json:
            typer.echo(json.dumps(listed))
        else:
            wide_console(WIDEST if wide else 0).print(modules_screen(listed, wide))
        return 1 if listed["conflicts"] or listed.get("absent") else 0

    run_with_suit(suit, work, needs_all=False)


def discover_modules(
    listen: Annotated[
        float, typer.Option(min=1, max=60, help="Seconds to listen; devices announce themselves each second.")
    ] = 3.0,
    host: Annotated[str, typer.Option(help="Address of this computer to listen on.")] = EVERYWHERE,
    as_json: AsJson = False,
) -> None:
    """Find modules of other makers that announce themselves in the network, and print their link lines."""
    found = asyncio.run(discovered(listen, host))
    if as_json:
        typer.echo(json.dumps([each._asdict() for each in found]))
        return
    if not found:
        typer.echo(
            "no module announced itself: is it in this network, does a firewall keep UDP back? (Serial and "
            "CAN devices do not announce themselves: their ports are in /dev/serial/by-id and `ip link`.)",
            err=True,
        )
        raise typer.Exit(1)
    for together in by_link(found):
        for each in together:
            battery = "" if each.battery_percent is None else f", battery {each.battery_percent} %"
            signal = "" if each.rssi_percent is None else f", signal {each.rssi_percent} %"
            typer.echo(f"# {each.carries} {each.unique_id}{battery}{signal}")
        typer.echo(link_line(*together))
    typer.echo("# NUMBER: the module's number in your rig file, which says where it sits")


@with_suit
def watch_modules(
    suit: SuitChoice,
    count: Annotated[int | None, typer.Option(min=1, help="End after so many tables.")] = None,
    wide: Wide = False,
) -> None:
    """Show the list live, until Ctrl-C."""

    async def work(operations: Operations) -> int:
        console, shown = wide_console(), 0
        with Live(console=console, auto_refresh=False) as live:
            while count is None or shown < count:
                screen = modules_screen(await operations.perform("list", {"listen_s": 1.0}), wide)
                live.update(screen, refresh=True)
                shown += 1
        return 0

    run_with_suit(suit, work, needs_all=False)


@with_suit
def identify(
    suit: SuitChoice,
    device: Annotated[str, typer.Argument(help="Module id, 'relay', or the beginning of a unique id.")],
    seconds: Annotated[int, typer.Option(min=0, max=255, help="How long it blinks; 0 stops it.")] = 5,
) -> None:
    """Make a module blink, to see which one it is."""

    async def work(operations: Operations) -> int:
        found = await operations.perform("identify", {"device": device, "seconds": seconds})
        what = f"blinks for {seconds} s" if seconds else "has stopped blinking"
        sys.stdout.write(f"module {found['module']} (unique id {found['unique_id']}) {what}\n")
        return 0

    run_with_suit(suit, work)


Device = Annotated[str, typer.Argument(help="Module id, 'relay', or the beginning of a unique id.")]


@with_suit
def show(suit: SuitChoice, device: Device) -> None:
    """Print all settings of a module."""

    async def work(operations: Operations) -> int:
        read = await operations.perform("read", {"device": device})
        typer.echo(f"# module {read['module']}, unique id {read['unique_id']}")
        for name, value in read["settings"].items():
            typer.echo(f"{name}: {_on_a_line(value)}")
        return 0

    run_with_suit(suit, work)


@with_suit
def set_settings(
    suit: SuitChoice,
    device: Device,
    settings: Annotated[list[str], typer.Argument(metavar="KEY=VALUE...", help="Settings and their values.")],
    as_json: AsJson = False,
) -> None:
    """Change settings of a module: written, committed, and read back. Needs --allow-writes."""
    wanted = dict(map(_parsed, settings))

    async def work(operations: Operations) -> int:
        done = await operations.perform("set", {"device": device, "settings": wanted})
        if as_json:
            typer.echo(json.dumps(done))
        else:
            _print_change(done["unique_id"], done["before"], done["after"])
        return 0

    run_with_suit(suit, work)


@with_suit
def undo(suit: SuitChoice) -> None:
    """Write back what stood in the modules before the last change. Needs --allow-writes."""

    async def work(operations: Operations) -> int:
        return print_restored(await operations.perform("undo", {}), "it stood so already")

    run_with_suit(suit, work)


@with_suit
def backup(
    suit: SuitChoice,
    file: Annotated[Path, typer.Argument(help="YAML file to write; - for the terminal.")],
    force: ReplaceFiles = False,
) -> None:
    """Save all settings of all modules that can be heard."""
    # An older backup may be the only one from before a change that is to be taken back.
    refuse_existing(file, force, option=None)

    async def work(operations: Operations) -> int:
        saved = await operations.perform("backup", {})
        text = f"# settings of {len(saved['modules'])} modules, by unique id\n" + _yaml(saved)
        if str(file) == "-":
            typer.echo(text, nl=False)
            return 0
        _write(file, text)
        typer.echo(f"settings of {len(saved['modules'])} modules are in {file}")
        return 0

    run_with_suit(suit, work)


@with_suit
def restore(
    suit: SuitChoice, file: Annotated[Path, typer.Argument(help="YAML file that `backup` wrote.")]
) -> None:
    """Write saved settings back to the modules they came from. Needs --allow-writes."""
    modules = _saved_modules(file)

    async def work(operations: Operations) -> int:
        return print_restored(await operations.perform("restore", {"modules": modules}), "nothing differs")

    run_with_suit(suit, work)


def _saved_modules(file: Path) -> dict[str, dict[str, Any]]:
    """Return settings by unique id from a file of ``backup``. Raises ``GatewayError`` for another file."""
    saved = load_yaml(file)
    modules = saved.get("modules") if isinstance(saved, dict) else None
    no_backup = f"{file} is no file that `modules backup` wrote"
    if not isinstance(modules, dict):
        raise GatewayError(f"{no_backup}: under 'modules:' it has no settings by unique id")
    for uid, settings in modules.items():
        try:
            parse_unique_id(str(uid))
        except ValueError as error:
            raise GatewayError(f"{no_backup}: under 'modules:' {error}") from error
        if not isinstance(settings, dict):
            raise GatewayError(f"{no_backup}: under '{uid}:' it has no settings by name")
    return {str(uid).lower(): settings for uid, settings in modules.items()}


def print_changes(changes: list[dict[str, Any]], otherwise: str) -> None:
    """Print one line for every setting that was changed, or ``otherwise``."""
    for change in changes:
        _print_change(change["unique_id"], change["before"], change["after"])
    if not changes:
        typer.echo(otherwise)


def print_restored(done: Mapping[str, Any], otherwise: str) -> int:
    """Print what was written back and what not. Exit code: 1 when it was not all."""
    is_all = not (done["failures"] or done["absent"])
    print_changes(done["changes"], otherwise if is_all else "nothing was changed")
    for uid in done["absent"]:
        typer.echo(f"{uid}: not heard, left out", err=True)
    for uid, reason in done["failures"].items():
        typer.echo(f"{uid}: {reason}", err=True)
    return 0 if is_all else 1


def _print_change(unique_id: str, before: dict[str, Any], after: dict[str, Any]) -> None:
    for name, value in after.items():
        was = before.get(name)
        typer.echo(f"{unique_id}: {name} {_brief(was)} → {_brief(value)}{' (as before)' * (was == value)}")


def _brief(value: Any) -> str:
    if value is None:
        return "?"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _parsed(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise GatewayError(f"'{text}' is no setting: write KEY=VALUE, such as sampling_rate=200")
    if name == "label":
        return name, value  # also when it looks like a number
    try:
        return name, yaml.safe_load(value)
    except yaml.YAMLError:
        return name, value


def _yaml(content: Any) -> str:
    text: str = yaml.safe_dump(
        content, sort_keys=False, default_flow_style=None, allow_unicode=True, width=100
    )
    return text


def _on_a_line(value: Any) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=sys.maxsize)
    return text.removesuffix("...\n").rstrip()


def _write(file: Path, text: str) -> None:
    with writing(file):
        write_whole(file, text.encode())


_STILL_S = 2.0
_LOOK_S = 0.5
_LISTED_S = 0.5
"""The shortest: who is there is asked for, and not how many samples each sends."""
_SIGNS = {
    "motion": "moved",
    "button": "had its button pressed",
    "tap": "was tapped",
    "double tap": "was tapped",
}
_KEYS = "keys, each with Enter: s skip this segment, r redo the one before, u undo the last change, q quit"


@with_suit
def assign(
    suit: SuitChoice,
    segment: Annotated[
        list[str] | None,
        typer.Option(help="Only this segment (may be given again); default: all of the rig."),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(help="The module for the one --segment, by unique id or module id: nothing is shaken."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Ask no questions.")] = False,
    timeout: Annotated[
        float | None, typer.Option(min=1, help="Skip a segment after so many seconds without a sign.")
    ] = None,
) -> None:
    """Give the modules the ids that the rig expects, by shaking or tapping them one after another.

    For each segment of the rig you are asked to shake or tap the module worn there. Whoever has the
    segment's id already gets the other's in exchange, so that no two modules share one at any time.
    Needs --allow-writes. Every change can be taken back with u, or later with `modules undo`.
    """
    if device is not None and (segment is None or len(segment) != 1):
        raise GatewayError("--device names the module for one segment: give that with --segment")

    async def work(operations: Operations) -> int:
        fitting = _Fitting(operations, Console(highlight=False, soft_wrap=True), yes, timeout)
        await fitting.begin(segment)
        if device is not None:
            return await fitting.assign_named(device)
        return await fitting.assign_all()

    run_with_suit(suit, work)


class _Fitting:
    """One round of assigning."""

    def __init__(
        self, operations: Operations, console: Console, is_sure: bool, timeout: float | None
    ) -> None:
        self._perform = operations.perform
        self._console = console
        self._is_sure = is_sure
        self._timeout = timeout
        self._lines = TypedLines()
        self._undoable = 0
        self._worn_by: dict[str, str] = {}  # unique id by segment, of this round

    async def begin(self, chosen: list[str] | None) -> None:
        """See who is there; give devices that share an id ids of their own. Raises ``GatewayError``."""
        listed = await self._perform("list", {"listen_s": _LISTED_S})
        if not listed["allows_writes"]:
            raise GatewayError(
                "assigning changes modules, which is not allowed: pass --allow-writes, or set "
                "'allow_device_writes: true' in the configuration (with --mqtt: of the gateway)"
            )
        if not listed["assigns"]:
            raise GatewayError(
                "there are modules of other makers alone, which keep no number: write 'module: NUMBER' at "
                "the link of each in the configuration"
            )
        # Two modules with one id cannot be told apart by their samples: they get ids before anything is
        # shaken.
        if listed["conflicts"]:
            await self._separate(listed)
            listed = await self._perform("list", {"listen_s": _LISTED_S})
        self._wardrobe = Wardrobe(listed)
        segments = list(self._wardrobe.segments)
        for name in chosen or ():
            if name not in segments:
                raise GatewayError(f"the rig has no module on '{name}'{nearest(name, segments)}")
        self._segments = chosen or segments
        self._console.print(f"{len(self._wardrobe.ids)} modules heard; {len(segments)} segments in the rig")

    async def assign_named(self, device: str) -> int:
        """Assign the module that was named, without any shaking."""
        unique_id = (await self._perform("read", {"device": device}))["unique_id"]
        if unique_id not in self._wardrobe.ids:  # it came later than the rest
            self._wardrobe = Wardrobe(await self._perform("list", {"listen_s": _LISTED_S}))
        if unique_id not in self._wardrobe.ids:
            raise GatewayError(
                f"device {unique_id} answered when it was asked by itself, and was not heard among all: "
                "look at the supply and the line of it, and type the same again"
            )
        proposal = self._wardrobe.propose(self._segments[0], unique_id)
        await self._carry_out(proposal)
        return 0

    async def assign_all(self) -> int:
        """Ask for one segment after another. Exit code: 0, or 1 when some were skipped."""
        from gateway.modules.motion import AmbiguousMotionError
        from gateway.modules.operations import RequestError

        self._console.print(f"{_KEYS}\nhold still ...")
        with contextlib.suppress(RequestError, AmbiguousMotionError):  # what moves here is what usually moves
            await self._perform("motion", {"seconds": _STILL_S})
        skipped: list[str] = []
        place = 0
        while place < len(self._segments):
            name = self._segments[place]
            step = await self._fit(name, f"[{place + 1}/{len(self._segments)}]")
            if step == "q":
                skipped += self._segments[place:]
                break
            if step in {"r", "u"}:
                place = max(0, place - 1)
                skipped = [each for each in skipped if each != self._segments[place]]
                self._worn_by.pop(self._segments[place], None)
                continue
            if step == "s":
                skipped.append(name)
            place += 1
        if skipped:
            self._console.print(f"not assigned: {', '.join(skipped)}", style="yellow")
        return 1 if skipped else 0

    async def _fit(self, segment: str, count: str) -> str:
        """Ask until the segment has its module; return ``done``, or the key that was pressed to leave it."""
        from gateway.modules.motion import AmbiguousMotionError
        from gateway.modules.operations import RequestError

        name = segment.replace("_", " ")
        while True:
            self._console.print(Text(f"{count} shake or tap the module on the {name}", "bold"))
            try:
                found = await self._next_sign()
            except (RequestError, AmbiguousMotionError) as error:
                self._console.print(f"  {error}", style="yellow")
                # Two modules moved at once, or an error at the suit: ask again, nothing was changed.
                continue
            if isinstance(found, str):
                if found == "u":
                    await self._undo()
                return found
            if found is None:
                self._console.print("  nothing moved in time: skipped", style="yellow")
                return "s"

            proposal = self._wardrobe.propose(segment, found["unique_id"])
            sign = _SIGNS.get(found["sign"], "was shaken")
            other = next((at for at, worn in self._worn_by.items() if worn == proposal.unique_id), None)
            if other is not None:  # who shakes for long has not seen yet that the next one is asked for
                self._console.print(
                    f"  module {proposal.before} {sign}, which is the one on the {other.replace('_', ' ')}: "
                    "hold it still (r: that segment once more)",
                    style="yellow",
                )
                continue
            self._console.print(f"  module {proposal.before} ({proposal.unique_id}) {sign}: {proposal}")
            if proposal.is_right_already or await self._agrees():
                await self._carry_out(proposal)
                self._worn_by[segment] = proposal.unique_id
                return "done"

    async def _next_sign(self) -> dict[str, Any] | str | None:
        """Return the module that moved, or a key, or None when the time is over.

        A key that was typed while the module of the segment before was looked for counts too.
        """
        loop = asyncio.get_running_loop()
        end = None if self._timeout is None else loop.time() + self._timeout
        continues = False
        while end is None or loop.time() < end:
            key = self._lines.typed()
            if key in {"s", "r", "u", "q"}:
                return key
            if key is not None:
                self._console.print(f"  {_KEYS}")
            # In short looks: a key is to be seen soon.
            found = await self._perform("motion", {"seconds": _LOOK_S, "continues": continues})
            continues = True
            if found["module"] is not None:
                return found
        return None

    async def _agrees(self) -> bool:
        if self._is_sure:
            return True
        self._console.print("  do it? \\[Y/n]")
        line = await self._lines.next()
        if line is None:
            raise GatewayError("no answer: the input has ended (--yes asks no questions)")
        return line in {"", "y", "yes"}

    async def _carry_out(self, proposal: Proposal) -> None:
        if proposal.is_right_already:
            self._console.print(
                f"  {proposal.segment}: module {proposal.after}, nothing to change", style="green"
            )
            return
        done = await self._perform("assign", {"ids": proposal.ids})
        self._wardrobe.note(done["changes"])
        self._undoable += 1
        self._console.print(
            f"  {proposal.segment}: {proposal.unique_id} is module {proposal.after} now "
            "(take it back: u, or mocap-gateway modules undo)",
            style="green",
        )

    async def _undo(self) -> None:
        if not self._undoable:
            self._console.print("  nothing was changed yet", style="yellow")
            return
        done = await self._perform("undo", {})
        self._undoable -= 1
        self._wardrobe.note(done["changes"])
        print_restored(done, "  it stood so already")

    async def _separate(self, listed: dict[str, Any]) -> None:
        for conflict in listed["conflicts"]:
            self._console.print(
                f"conflict: module id {conflict['module']} is shared by "
                f"{' and '.join(conflict['unique_ids'])}: all but the first get a free id",
                style="bold red",
            )
        if not await self._agrees():
            raise GatewayError("modules that share an id cannot be told apart: nothing was changed")
        print_changes((await self._perform("separate", {}))["changes"], "it is solved already")


modules_app = typer.Typer(
    help="List, identify, assign and configure the modules of a suit; fetch files from its memory card.",
    epilog="Examples: mocap-gateway modules list -c my.yaml; mocap-gateway modules discover",
    no_args_is_help=True,
)

_EXAMPLE = "Example: mocap-gateway modules"
modules_app.command(
    "list",
    epilog="Examples: mocap-gateway modules list -c my.yaml; "
    "mocap-gateway modules list --mqtt 127.0.0.1:1883",
)(list_modules)
modules_app.command("discover", epilog=f"{_EXAMPLE} discover --listen 5")(discover_modules)
modules_app.command("watch", epilog=f"{_EXAMPLE} watch --link /dev/ttyUSB0 --rig suit_17")(watch_modules)
modules_app.command("identify", epilog=f"{_EXAMPLE} identify 3 --seconds 10 -c my.yaml")(identify)
modules_app.command(
    "assign",
    epilog="Examples: mocap-gateway modules assign -c my.yaml --allow-writes; "
    "mocap-gateway modules assign --segment left_shank --device 3f2a --yes -c my.yaml --allow-writes",
)(assign)
modules_app.command("show", epilog=f"{_EXAMPLE} show 3 -c my.yaml")(show)
modules_app.command(
    "set", epilog=f"{_EXAMPLE} set 3 sampling_rate=200 label=left_shank -c my.yaml --allow-writes"
)(set_settings)
modules_app.command("undo", epilog=f"{_EXAMPLE} undo -c my.yaml --allow-writes")(undo)
modules_app.command("backup", epilog=f"{_EXAMPLE} backup suit.yaml -c my.yaml")(backup)
modules_app.command("restore", epilog=f"{_EXAMPLE} restore suit.yaml -c my.yaml --allow-writes")(restore)
modules_app.command("test", epilog=f"{_EXAMPLE} test --link /dev/ttyUSB0 --allow-writes")(conformance)
modules_app.add_typer(card_app, name="card")
