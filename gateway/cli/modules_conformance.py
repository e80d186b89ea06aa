"""``mocap-gateway modules test``: whether a module keeps the rules of the wire protocol."""

from __future__ import annotations

import asyncio
import json
from typing import Annotated

import typer

from gateway.cli.options import AsJson
from gateway.errors import GatewayError, nearest

_MARKS = {"kept": "ok", "broken": "BROKEN", "skipped": "skipped"}


def conformance(
    link: Annotated[str, typer.Option(help="Port or URL of the module.")],
    device: Annotated[
        str | None, typer.Option(help="Module id or beginning of a unique id, where there are several.")
    ] = None,
    allow_writes: Annotated[
        bool,
        typer.Option("--allow-writes", help="Test settings too; those of before are put back afterwards."),
    ] = False,
    rule: Annotated[
        list[str] | None, typer.Option(help="Only this rule (may be given again); default: all of them.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Test a module's firmware against the rules of the wire protocol. Ends with 1 when it breaks one."""
    from devices.conformance import RULES

    names = [each.name for each in RULES]
    for name in rule or ():
        if name not in names:
            raise GatewayError(f"there is no rule '{name}'{nearest(name, names)}")
    code = asyncio.run(_report(link, device, allow_writes, rule or [], as_json))
    raise typer.Exit(code)


async def _report(url: str, device: str | None, allow_writes: bool, only: list[str], as_json: bool) -> int:
    from devices.conformance import check_module
    from devices.conformance.bench import NoModuleError
    from devices.endpoints import link_from_url

    findings = []
    try:
        # Findings are printed as they come: the whole takes minutes.
        async for found in check_module(
            link_from_url(url, name="module"), device, allow_writes=allow_writes, only=only
        ):
            findings.append(found)
            if not as_json:
                detail = f"\n         {found.detail}" if found.detail else ""
                typer.echo(f"{_MARKS[found.outcome]:8} {found.rule}: {found.statement}{detail}")
    except NoModuleError as error:
        raise GatewayError(f"{url}: {error}") from error
    counts = {outcome: sum(each.outcome == outcome for each in findings) for outcome in _MARKS}
    if as_json:
        typer.echo(json.dumps({**counts, "rules": [each._asdict() for each in findings]}))
    else:
        typer.echo(f"{counts['kept']} kept, {counts['broken']} broken, {counts['skipped']} skipped")
    return 1 if counts["broken"] else 0
