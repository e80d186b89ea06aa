"""Progress and results of a sensor calibration, for the terminal and for scripts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rich.table import Table
from rich.text import Text

from gateway.calibration.sensor_session import REST_S, Progress, Result, SensorSession
from gateway.calibration.sensors import ENOUGH_COVERAGE, EllipsoidResult, GyrometerResult

_COLOURS = {"good": "green", "fair": "yellow", "poor": "red"}
_BAR = 16
_SIDES_NAMED = 3


def advice(session: SensorSession, progress: Mapping[int, Progress]) -> str:
    """What to do next, for the suit as a whole."""
    heard = [one for one in progress.values() if one.samples]
    if not heard:
        return "waiting for the modules"
    if "gyrometer" in session.sensors and any(one.rest_s < REST_S for one in heard):
        return f"put all modules down and leave them untouched for {REST_S:.0f} s"
    if "accelerometer" in session.sensors and any(
        one.positions < session.wanted_positions or one.sides_missing for one in heard
    ):
        moving = not all(one.is_at_rest for one in heard)
        return (
            "hold still for two seconds"
            if moving
            else "now turn them to another side, and let them lie there"
        )
    if "magnetometer" in session.sensors and any(one.coverage < ENOUGH_COVERAGE for one in heard):
        return "turn them slowly about all axes, away from iron, until the bars are full"
    silent = [str(module) for module, one in progress.items() if not one.samples]
    return f"waiting for module {', '.join(silent)}" if silent else "that is enough"


def progress_table(session: SensorSession, progress: Mapping[int, Progress]) -> Table:
    """How far every module is."""
    table = Table("module", *session.sensors, "")
    for module, one in progress.items():
        cells = {
            "gyrometer": _amount(one.rest_s, REST_S, f"{one.rest_s:.0f} s at rest"),
            "accelerometer": _positions(one, session.wanted_positions),
            "magnetometer": _bar(one.coverage),
        }
        state = "silent" if not one.samples else "at rest" if one.is_at_rest else "moving"
        done = Text("enough", "green") if session.is_enough(one) else Text(state, "dim")
        table.add_row(str(module), *(cells[sensor] for sensor in session.sensors), done)
    return table


def result_table(found: Mapping[int, Mapping[str, Result | str]]) -> Table:
    """What was found, and how good it is."""
    table = Table("module", "sensor", "bias", "spread of the norm", "quality", "why")
    for module, results in found.items():
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


def results_as_json(found: Mapping[int, Mapping[str, Result | str]]) -> dict[str, object]:
    """The same for scripts; SI units, µT."""
    return {str(module): {s: _plain(r) for s, r in results.items()} for module, results in found.items()}


def _plain(result: Result | str) -> dict[str, object]:
    if isinstance(result, str):
        return {"quality": "none", "reasons": [result]}
    quality = {
        "quality": result.quality.verdict,
        "score": round(result.quality.score, 3),
        "reasons": list(result.quality.reasons),
    }
    if isinstance(result, GyrometerResult):
        return quality | {"bias": result.bias.tolist(), "rest_s": round(result.rest_s, 2)}
    fit = result.fit
    return quality | {
        "bias": fit.bias.tolist(),
        "matrix": fit.matrix.tolist(),
        "used": result.used,
        "coverage": round(fit.coverage, 3),
        "spread_before": fit.spread_before,
        "spread_after": fit.spread_after,
    }


def _bias(sensor: str, result: Result) -> str:
    if isinstance(result, GyrometerResult):
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
