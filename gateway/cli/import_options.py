"""The options of ``import``, one name each."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

from gateway.imports import FORMATS
from gateway.imports.suits import BODY

FormatName = StrEnum("FormatName", {name: name for name in ("auto", *FORMATS)})  # type: ignore[misc]


Files = Annotated[
    list[Path], typer.Argument(help="Files, one a module where the maker has it so; or folders.")
]
Output = Annotated[
    Path | None, typer.Option("--output", "-o", help="The recording; else NAME.mcap in this folder.")
]
Format = Annotated[FormatName, typer.Option("--format", help="What they are; auto looks into them.")]
Maps = Annotated[
    list[str] | None,
    typer.Option("--map", help="NAME=SEGMENT, a YAML file of such lines, or OpenSense's XML. Repeatable."),
]
Columns = Annotated[Path | None, typer.Option(help="For csv: map of its columns (YAML).")]
Body = Annotated[str | None, typer.Option(help=f"Body, name or file; else what is worn of {BODY}.")]
Rig = Annotated[str | None, typer.Option(help="Rig, name or file, instead of any map.")]
Reconstructor = Annotated[
    str | None, typer.Option(help="Method; else independent, or fused where only orientations came.")
]
Neutral = Annotated[
    str | None,
    typer.Option(metavar="FROM:TO", help="Seconds in which the wearer stood upright, arms down."),
]
Forward = Annotated[
    Literal["x", "y", "z", "-x", "-y", "-z"] | None,
    typer.Option(help="With --neutral: axis of the root's module that points forward."),
]
Rate = Annotated[float | None, typer.Option(min=0.1, help="Samples a second, where files do not tell.")]
Align = Annotated[
    Literal["stamps", "start"], typer.Option(help="Modules by their time stamps, or all begin together.")
]
Partial = Annotated[bool, typer.Option("--partial", help="Take what comes before the first damage.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")]
