"""``mocap-gateway doctor``: whether a set-up is right."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gateway.cli.options import AsJson
from gateway.doctor.findings import Verdict
from gateway.errors import SettingsError

if TYPE_CHECKING:
    from gateway.doctor.findings import Finding


_COLOURS = {Verdict.GOOD: "green", Verdict.WARNING: "yellow", Verdict.BAD: "red"}


def doctor(
    config: Annotated[Path, typer.Option("--config", "-c", help="Configuration file.")] = Path(
        "config/gateway.yaml"
    ),
    module_rate: Annotated[
        float | None,
        typer.Option(min=1, max=4000, help="Samples of each module a second; else assembly.rate_hz."),
    ] = None,
    listen: Annotated[
        float, typer.Option(min=0, max=30, help="How long the suit is listened to, s; 0: not at all.")
    ] = 2.0,
    as_json: AsJson = False,
) -> None:
    """Examine a set-up: configuration, ports, lines and buses, modules, broker, clocks, disk.

    Changes nothing. Ends with 1 when something will not work. A gateway that runs is asked; else the suit is
    listened to.
    """
    from gateway.doctor.examination import examine_file

    if not config.is_file():
        raise SettingsError(f"no configuration file {config}: name yours with -c")
    console = Console(stderr=as_json)
    # To standard error with --json: a script reads the findings from standard output.
    with console.status("examining"):
        findings = list(examine_file(config, module_rate, listen))
    if as_json:
        typer.echo(json.dumps([asdict(finding) for finding in findings], indent=2, ensure_ascii=False))
    else:
        console.print(_table(config, findings))
    if any(finding.verdict is Verdict.BAD for finding in findings):
        raise typer.Exit(1)


def _table(config: Path, findings: list[Finding]) -> Table:
    table = Table("what", "", "found", "remedy", title=escape(str(config)), title_justify="left")
    for finding in findings:
        verdict = f"[{_COLOURS[finding.verdict]}]{finding.verdict}[/]"
        table.add_row(escape(finding.subject), verdict, escape(finding.found), escape(finding.remedy))
    return table
