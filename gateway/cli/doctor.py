"""``mocap-gateway doctor``: what is wrong with a set-up, and what to do."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from gateway.doctor import Verdict, examine
from gateway.settings import load_gateway_settings

_COLOURS = {Verdict.GOOD: "green", Verdict.WARNING: "yellow", Verdict.BAD: "red"}


def doctor(
    config: Annotated[Path, typer.Option("--config", "-c", help="Configuration file.")] = Path(
        "config/gateway.yaml"
    ),
    module_rate: Annotated[
        float | None,
        typer.Option(min=1, max=4000, help="Samples of each module a second; else assembly.rate_hz."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a script.")] = False,
) -> None:
    """Examine a set-up: rig, ports, capacity of serial lines and CAN buses, broker.

    Ends with 1 when something will not work.
    """
    settings = load_gateway_settings(config)
    findings = list(examine(settings, config, module_rate or settings.assembly.rate_hz))
    if as_json:
        typer.echo(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        table = Table("what", "", "found", "remedy", title=str(config), title_justify="left")
        for finding in findings:
            verdict = f"[{_COLOURS[finding.verdict]}]{finding.verdict}[/]"
            table.add_row(finding.subject, verdict, finding.found, finding.remedy)
        Console().print(table)
    if any(finding.verdict is Verdict.BAD for finding in findings):
        raise typer.Exit(1)
