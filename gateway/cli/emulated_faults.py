"""``mocap-gateway emulate --faults``: the file read, and what came of it told."""

from __future__ import annotations

from pathlib import Path

from devices.emulators.fault_plan import FaultPlan
from devices.emulators.faulty_suit import FaultySuit
from devices.emulators.suit_traffic import SuitTraffic
from gateway.errors import GatewayError
from gateway.support.settings_files import load_settings


def faulty(traffic: SuitTraffic, path: Path) -> FaultySuit:
    """A suit with the faults of a file. Raises ``GatewayError`` naming file and field."""
    try:
        return FaultySuit(traffic, load_settings(path, FaultPlan))
    except KeyError as error:
        raise GatewayError(f"{path}: {error.args[0]}") from error


def plan_of(source: object) -> FaultPlan:
    """What goes wrong with a source of transmissions: nothing, unless it is a faulty suit."""
    return source.plan if isinstance(source, FaultySuit) else FaultPlan()


def told(source: object) -> str:
    """What befell a suit, for whoever started it."""
    if not isinstance(source, FaultySuit):
        return ""
    befell = ", ".join(f"{kind} {count}" for kind, count in sorted(source.counts.items()))
    return f"; faults: {befell or 'none'}"
