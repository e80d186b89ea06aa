"""The list of modules as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from firmware_protocol import RELAY

_UNKNOWN = "–"
_LOW_BATTERY = 20
_NOTABLE_LOSS = 1.0
_NARROWEST = 170
_COLUMNS = (
    "id", "unique id", "segment", "firmware", "battery", "Hz", "loss %", "gaps", "resets",
    "ppm", "residual µs", "offset s",
)  # fmt: skip
_TEXT_COLUMNS = {"unique id", "segment", "firmware", "gaps"}


def wide_console() -> Console:
    """The terminal; what is not one gets room for whole tables."""
    console = Console()
    return console if console.is_terminal else Console(width=_NARROWEST)


def modules_screen(listed: Mapping[str, Any]) -> RenderableType:
    """Table, what is missing, and conflicts with their remedy."""
    shared = {conflict["module"] for conflict in listed["conflicts"]}
    table = Table()
    for column in _COLUMNS:
        table.add_column(column, justify="left" if column in _TEXT_COLUMNS else "right", no_wrap=True)
    for module in listed["modules"]:
        table.add_row(*_cells(module), style="bold red" if module["module"] in shared else "")
    return Group(table, *_remarks(listed))


def _cells(module: Mapping[str, Any]) -> list[Text]:
    battery, loss = module["battery_percent"], module["loss_percent"]
    is_relay = module["module"] == RELAY
    return [
        Text("relay" if is_relay else str(module["module"])),
        Text(module["unique_id"] or "does not answer", "" if module["unique_id"] else "yellow"),
        Text(module["segment"] or ("" if is_relay else "not in the rig"), "" if module["segment"] else "dim"),
        Text(module["firmware"] or _UNKNOWN),
        Text(_number(battery, ".0f", " %"), "red" if battery is not None and battery < _LOW_BATTERY else ""),
        Text(f"{module['rate_hz']:.1f}", "yellow" if not module["rate_hz"] and not is_relay else ""),
        Text(_number(loss, ".2f"), "yellow" if loss is not None and loss > _NOTABLE_LOSS else ""),
        Text(" ".join(f"{length}:{count}" for length, count in module["gaps"].items())),
        Text(str(module["resets"]), "yellow" if module["resets"] else ""),
        *_clock_cells(module["clock"]),
    ]


def _clock_cells(clock: Mapping[str, Any] | None) -> list[Text]:
    """Rate, residual and offset; a rate that is not known yet says so."""
    if clock is None:
        return [Text(_UNKNOWN)] * 3
    is_settled = clock["state"] == "settled"
    return [
        Text(_number(clock["ppm"], "+.1f")) if is_settled else Text("measuring", "dim"),
        Text(_number(clock["residual_us"], ".0f")),
        Text(f"{clock['offset_ns'] * 1e-9:.6f}"),
    ]


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
