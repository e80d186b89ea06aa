"""``modules assign``: shake the module on each segment in turn, and it gets that segment's id."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from gateway.cli.modules_settings import print_changes, print_restored
from gateway.cli.modules_suit import Operations, SuitChoice, run_with_suit, with_suit
from gateway.cli.typed_lines import TypedLines
from gateway.errors import GatewayError, nearest
from gateway.modules.assignment import Proposal, Wardrobe
from gateway.modules.motion_watch import AmbiguousMotionError
from gateway.modules.operations import RequestError

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

    async def begin(self, chosen: list[str] | None) -> None:
        """See who is there; give devices that share an id ids of their own. Raises ``GatewayError``."""
        listed = await self._perform("list", {"listen_s": _LISTED_S})
        if not listed["allows_writes"]:
            raise GatewayError(
                "assigning changes modules, which is not allowed: pass --allow-writes, or set "
                "'allow_device_writes: true' in the configuration (with --mqtt: of the gateway)"
            )
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
        read = await self._perform("read", {"device": device})
        proposal = self._wardrobe.propose(self._segments[0], read["unique_id"])
        await self._carry_out(proposal)
        return 0

    async def assign_all(self) -> int:
        """Ask for one segment after another. Exit code: 0, or 1 when some were skipped."""
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
                continue
            if step == "s":
                skipped.append(name)
            place += 1
        if skipped:
            self._console.print(f"not assigned: {', '.join(skipped)}", style="yellow")
        return 1 if skipped else 0

    async def _fit(self, segment: str, count: str) -> str:
        """Until the segment has its module: ``done``; or the key that leaves it."""
        spoken = segment.replace("_", " ")
        while True:
            self._console.print(Text(f"{count} shake or tap the module on the {spoken}", "bold"))
            try:
                found = await self._next_sign()
            except (RequestError, AmbiguousMotionError) as error:
                self._console.print(f"  {error}", style="yellow")
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
            self._console.print(f"  module {proposal.before} ({proposal.unique_id}) {sign}: {proposal}")
            if proposal.is_right_already or await self._agrees():
                await self._carry_out(proposal)
                return "done"

    async def _next_sign(self) -> dict[str, Any] | str | None:
        """The module that moved, or a key, or None when the time is over.

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
