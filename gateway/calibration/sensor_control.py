"""The family ``sensors``: the calibration of all modules' sensors by a running gateway."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from typing import Any

from devices.calibration import SensorCalibration
from gateway.body.skeleton import WornSuit
from gateway.calibration.kept_rig import KeptRig
from gateway.calibration.rig_file import write_calibrated_rig
from gateway.calibration.sensor_feed import fed
from gateway.calibration.sensor_session import (
    SENSORS,
    Progress,
    Result,
    SensorSession,
    advice_on,
    combined,
    results_as_json,
    usable,
)
from gateway.contract.requests import AcceptSensorsRequest, BeginSensorsRequest, Request, asked
from gateway.errors import GatewayError
from gateway.modules.makers import MakersModules
from gateway.modules.operations import ModuleOperations
from gateway.sources.suit import SuitSource


class SensorControl:
    """One session at a time. Poses go on meanwhile; what is found is used once the rig is read again."""

    def __init__(
        self,
        suit: Callable[[], WornSuit],
        rig: KeptRig,
        stream: SuitSource,
        makers: MakersModules,
        operations: ModuleOperations,
    ) -> None:
        """Calibrate sensors of the suit that ``suit`` returns; accepted results are written to ``rig``."""
        self._suit, self._rig = suit, rig
        self._stream, self._makers, self._operations = stream, makers, operations
        self._session: SensorSession | None = None
        self._feeding = contextlib.ExitStack()
        self._found: dict[int, dict[str, Result | str]] | None = None
        self._verbs: dict[str, Callable[[Any], Awaitable[dict[str, Any]]]] = {
            "begin": self._begin,
            "status": self._status,
            "result": self._find,
            "accept": self._accept,
            "cancel": self._cancel,
        }

    async def perform(self, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Perform a request of ``gateway.contract.requests``. Raises ``GatewayError``."""
        request = asked("sensors", verb, data)
        return await self._verbs[verb](request)

    async def _begin(self, request: BeginSensorsRequest) -> dict[str, Any]:
        suit = self._suit()
        modules = suit.module_ids if request.modules is None else tuple(request.modules)
        if strange := [module for module in modules if module not in suit.module_ids]:
            raise GatewayError(
                f"the rig has no module {strange[0]}: it has {', '.join(map(str, suit.module_ids))}"
            )
        await self._cancel()
        self._session = SensorSession(
            modules,
            gravity=-float(suit.gravity[2]),
            field_ut=float(sum(suit.magnetic_field**2) ** 0.5),
            sensors=request.sensors or SENSORS,
            has_levelled_cube=request.cube,
        )
        self._feeding.enter_context(fed(self._session, self._stream, self._makers))
        return {"sensors": list(self._session.sensors), "modules": list(modules)}

    async def _status(self, _request: Request) -> dict[str, Any]:
        session = self._session
        if session is None:
            return {"phase": "idle"}
        progress = {module: one.progress() for module, one in session.modules.items()}
        advice = advice_on(session, progress)
        return {
            "phase": "watching" if self._found is None else "found",
            "advice": advice.key,
            "waited_for": list(advice.modules),
            "enough": all(session.is_enough(one) for one in progress.values()),
            "modules": [self._module_message(session, module, one) for module, one in progress.items()],
        }

    def _module_message(self, session: SensorSession, module: int, one: Progress) -> dict[str, Any]:
        suit = self._suit()
        row = suit.module_ids.index(module)
        names = zip(suit.module_of_segment, suit.skeleton.segment_names, strict=True)
        return {
            "module": module,
            "segment": next((name for worn, name in names if worn == row), None),
            "heard": one.samples > 0,
            "at_rest": one.is_at_rest,
            "rest_s": round(one.rest_s, 1),
            "positions": one.positions,
            "wanted_positions": session.wanted_positions,
            "sides_missing": one.sides_missing,
            "coverage": round(one.coverage, 2),
            "enough": session.is_enough(one),
        }

    async def _find(self, _request: Request | None = None) -> dict[str, Any]:
        if (session := self._session) is None:
            raise GatewayError("no calibration of sensors is under way: ask for sensors/begin first")
        self._feeding.close()
        if self._found is None:
            self._found = await asyncio.to_thread(
                lambda: {module: session.results(module) for module in session.modules}
            )
        return {"modules": results_as_json(self._found)}

    async def _accept(self, request: AcceptSensorsRequest) -> dict[str, Any]:
        await self._find()
        assert self._found is not None
        kept = {module: usable(results, request.poor) for module, results in self._found.items()}
        kept = {module: results for module, results in kept.items() if results}
        if not kept:
            raise GatewayError("nothing in the result is good enough to be used: see sensors/result")
        answer: dict[str, Any] = {"accepted": sorted(kept)}
        answer |= await (self._flash(kept) if request.flash else self._write(kept))
        await self._cancel()
        return answer

    async def _flash(self, kept: Mapping[int, dict[str, Result | str]]) -> dict[str, Any]:
        """Write results to the modules' flash, on top of what they correct already."""
        for module, results in kept.items():
            await flash(self._operations, module, results)
        return {"file": None, "is_configured": False}

    async def _write(self, kept: Mapping[int, dict[str, Result | str]]) -> dict[str, Any]:
        """Write results to the rig file; a gateway uses it once its configuration is read anew."""
        suit, session = self._suit(), self._session
        assert session is not None
        calibrations = {m: combined(each, suit.calibrations.get(m)) for m, each in kept.items()}
        dip_deg = session.dip_deg({m: c for m, c in calibrations.items() if "magnetometer" in kept[m]})
        source, target = self._rig.source, self._rig.target
        await asyncio.to_thread(write_calibrated_rig, source, target, calibrations, None, dip_deg)
        return {"file": str(target), "is_configured": self._rig.name_in_configuration()}

    async def _cancel(self, _request: Request | None = None) -> dict[str, Any]:
        self._feeding.close()
        self._session, self._found = None, None
        return {}


async def flash(operations: ModuleOperations, module: int, results: dict[str, Result | str]) -> None:
    """Write to a module's flash, on top of what it corrects already. Raises ``GatewayError``."""
    read = await operations.perform("read", {"device": str(module)})
    if "calibration" not in read["settings"]:
        raise GatewayError(
            f"module {module} is another maker's and keeps no calibration of ours: write to a rig file"
        )
    before = SensorCalibration.from_setting(read["settings"]["calibration"])
    after = replace(combined(results).after(before), temperature_c=before.temperature_c)
    setting = {"calibration": list(after.to_setting())}
    await operations.perform("set", {"device": str(module), "settings": setting})
