"""Options of commands that solve recordings anew: with another rig, by another method."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.options import with_options
from gateway.settings import MAX_DELAY_MS


@dataclass(frozen=True)
class SolvedOtherwise:
    """What the user wants solved in another way than it was recorded; None: as recorded."""

    with_rig: Annotated[
        str | None,
        typer.Option("--with", metavar="RIG", help="Solve anew with this rig (file or name)."),
    ] = None
    reconstructor: Annotated[str | None, typer.Option(help="Solve anew by this method.")] = None
    delay_ms: Annotated[
        float | None,
        typer.Option(min=0, max=MAX_DELAY_MS, help="For gyro_free: poses come so much later, and better."),
    ] = None
    smooth: Annotated[bool | None, typer.Option(help="Solve anew, forward and backward: more accurate.")] = (
        None
    )

    @property
    def is_asked_for(self) -> bool:
        """Whether anything is to be other than recorded."""
        is_otherwise = self.delay_ms is not None or self.smooth is not None
        return bool(self.with_rig or self.reconstructor or is_otherwise)

    def target(self, file: Path) -> Path:
        """Return where the new recording goes unless a place is named: after what is other in it."""
        rig = Path(self.with_rig).stem if self.with_rig else None
        way = {True: "smoothed", False: "forward", None: None}[self.smooth]
        late = None if self.delay_ms is None else f"{self.delay_ms:g}ms"
        marks = [mark for mark in (rig, self.reconstructor, late, way) if mark]
        return file.with_name(f"{file.stem}_{'_'.join(marks)}.mcap")


with_solving = with_options(SolvedOtherwise)
"""For a command whose first parameter is a ``SolvedOtherwise``."""
