"""The list of modules as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

from firmware_protocol import RELAY

_UNKNOWN = "–"
_LOW_BATTERY = 20
_NOTABLE_LOSS = 1.0
_NARROWEST = 170
WIDEST = 150
"""Columns that a wide table takes at most, save for many kinds of gaps."""
_BRIEF = ("id", "segment", "unique id", "battery", "Hz", "loss %")
"""What fits on 80 columns."""
_COLUMNS = (*_BRIEF, "firmware", "gaps", "resets", "ppm", "residual µs", "offset s")
_TEXT_COLUMNS = {"unique id", "segment", "firmware", "gaps"}
_FOLDED_COLUMNS = {"segment"}


def wide_console(narrowest: int = 0) -> Console:
    """Return the terminal; what is not one gets room for whole tables.

    narrowest: columns that lines have at least; the terminal breaks them where it has fewer.
    """
    console = Console()
    width = console.width if console.is_terminal else _NARROWEST
    return Console(width=max(width, narrowest))


def modules_screen(listed: Mapping[str, Any], is_wide: bool = False) -> RenderableType:
    """Return the table, what is missing, and conflicts with their remedy."""
    shared = {conflict["module"] for conflict in listed["conflicts"]}
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    columns = _COLUMNS if is_wide else _BRIEF
    for column in columns:
        justify: JustifyMethod = "left" if column in _TEXT_COLUMNS else "right"
        table.add_column(column, justify=justify, no_wrap=column not in _FOLDED_COLUMNS, overflow="fold")
    for module in listed["modules"]:
        cells = _cells(module)
        style = "bold red" if module["module"] in shared else ""
        table.add_row(*(cells[column] for column in columns), style=style)
    return Group(table, *_remarks(listed))


def _cells(module: Mapping[str, Any]) -> dict[str, Text]:
    battery, rate, loss = module["battery_percent"], module["rate_hz"], module["loss_percent"]
    is_relay = module["module"] == RELAY
    ppm, residual, offset = _clock_cells(module["clock"])
    return {
        "id": Text("relay" if is_relay else str(module["module"])),
        "segment": Text(
            module["segment"] or ("" if is_relay else "not in the rig"), "" if module["segment"] else "dim"
        ),
        "unique id": Text(module["unique_id"] or "does not answer", "" if module["answers"] else "yellow"),
        "battery": Text(
            _number(battery, ".0f", " %"), "red" if battery is not None and battery < _LOW_BATTERY else ""
        ),
        "Hz": Text(f"{rate:.{int(rate < 1000)}f}", "yellow" if not rate and not is_relay else ""),
        "loss %": Text(_number(loss, ".2f"), "yellow" if loss is not None and loss > _NOTABLE_LOSS else ""),
        "firmware": Text(module["firmware"] or _UNKNOWN),
        "gaps": Text(" ".join(f"{length}:{count}" for length, count in module["gaps"].items())),
        "resets": Text(str(module["resets"]), "yellow" if module["resets"] else ""),
        "ppm": ppm,
        "residual µs": residual,
        "offset s": offset,
    }


def _clock_cells(clock: Mapping[str, Any] | None) -> tuple[Text, Text, Text]:
    """Return rate, residual and offset; a rate that is not known yet says so."""
    if clock is None:
        return Text(_UNKNOWN), Text(_UNKNOWN), Text(_UNKNOWN)
    is_settled = clock["state"] == "settled"
    return (
        Text(_number(clock["ppm"], "+.1f")) if is_settled else Text("measuring", "dim"),
        Text(_number(clock["residual_us"], ".0f")),
        Text(f"{clock['offset_ns'] * 1e-9:.6f}"),
    )


def _remarks(listed: Mapping[str, Any]) -> list[Text]:
    remarks = [
        Text(
            f"conflict: module id {conflict['module']} is shared by {' and '.join(conflict['unique_ids'])}: "
            "their samples cannot be told apart.\n"
            "  remedy: mocap-gateway modules assign (gives one a free id, then asks which is which), or\n"
            f"  mocap-gateway modules set {conflict['unique_ids'][-1]} module_id=FREE_ID",
            "bold red",
        )
        for conflict in listed["conflicts"]
    ]
    deaf = [str(module["module"]) for module in listed["modules"] if not module["answers"]]
    if deaf:
        remarks.append(
            Text(
                f"no answer to commands: {', '.join(deaf)}: samples come and count; to be identified, "
                "assigned or set, its firmware must take commands, and what is sent must reach it",
                "yellow",
            )
        )
    present = {module["module"] for module in listed["modules"]}
    missing = [f"{name} ({module})" for name, module in listed["segments"].items() if module not in present]
    if missing:
        remarks.append(
            Text(
                f"not heard: {', '.join(missing)}: switched off, out of range, or with another id "
                "(mocap-gateway modules assign)",
                "yellow",
            )
        )
    return remarks


def _number(value: float | None, form: str, unit: str = "") -> str:
    return _UNKNOWN if value is None else f"{value:{form}}{unit}"
