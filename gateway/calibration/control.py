"""Calibrations and resets of a running gateway, on request. Belongs to one event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import numpy as np

from gateway.body.anthropometry import lengths_of
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.calibration.body_result import BodyResult, ModuleResult
from gateway.calibration.body_session import BodySession
from gateway.calibration.kept_rig import KeptRig, measured
from gateway.calibration.mounting import history, mounting_event, restore, write_mounted_rig
from gateway.calibration.quality import Quality
from gateway.contract.requests import (
    AcceptCalibrationRequest,
    BeginCalibrationRequest,
    CalibrationStepRequest,
    MeasureRequest,
    Request,
    RestoreCalibrationRequest,
    asked,
)
from gateway.errors import GatewayError
from gateway.pipeline import RESET_EVENT, Pipeline

STILL = np.radians(6.0)
"""Angular rate below which a module counts as still in the live display, rad/s."""
FIRST_FRAME_S = 3.0
"""So long a step waits for the first samples: modules of a gateway that has just begun anew come soon."""

ApplyEvent = Callable[[str, Mapping[str, Any]], dict[str, object]]
"""Hands an event to the pipeline and to the recording."""
Wear = Callable[[Mapping[str, Any]], Awaitable[None]]
"""Has the suit worn as a ``calibrated`` event says, while poses go on."""
ReadAnew = Callable[[], Awaitable[Any]]
"""Has the configuration read anew; raises ``GatewayError`` where there is none."""


class ResetControl:
    """The family ``reset``."""

    def __init__(self, apply_event: ApplyEvent) -> None:
        self._apply_event = apply_event

    async def perform(self, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Perform a reset ``heading``, ``full``, ``mounting`` or ``position``. Raises ``GatewayError``."""
        request = asked("reset", verb, data).model_dump()
        facing = float(np.radians(request.get("facing_deg", 0.0)))
        return self._apply_event(RESET_EVENT, {"kind": verb, "facing": facing})


class CalibrationControl:
    """The family ``calibration``: one session at a time."""

    def __init__(self, pipeline: Pipeline, rig: KeptRig, wear: Wear, read_anew: ReadAnew) -> None:
        self._pipeline = pipeline
        self._rig = rig
        self._wear, self._read_anew = wear, read_anew
        self._session: BodySession | None = None
        self._result: BodyResult | None = None
        self._running: asyncio.Task[None] | None = None
        self._phase = "idle"
        self._ends_at = 0.0
        self._verbs: dict[str, Callable[[Any], Any]] = {
            "measure": self._measure,
            "begin": self._begin,
            "step": self._step,
            "status": self._status,
            "result": self._find_result,
            "accept": self._accept,
            "cancel": self._cancel,
            "history": self._history,
            "restore": self._restore,
        }

    async def perform(self, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Perform a request of ``gateway.contract.requests``. Raises ``GatewayError``."""
        request = asked("calibration", verb, data)
        found = self._verbs[verb](request)
        answer: dict[str, Any] = await found if asyncio.iscoroutine(found) else found
        return answer

    async def _measure(self, request: MeasureRequest) -> dict[str, Any]:
        """Answer with the measures; new ones are kept first, and worn once they are read."""
        skeleton = self._pipeline.suit.skeleton
        changes = measured(request.height_m, request.mass_kg, request.lengths)
        if not changes:
            return {"subject": self._rig.subject().as_json(), "lengths": lengths_of(skeleton), "file": None}
        if self._rig.config is None:
            raise GatewayError(
                "this gateway has no configuration file to keep measures for: start it with "
                "`mocap-gateway run -c FILE`"
            )
        # Poses that were taken with another body would be solved against the wrong lengths.
        if self._session is not None:
            raise GatewayError("poses have been begun, with the body as it was: cancel them, then measure")
        subject, body = self._rig.keep_subject(changes)
        self._rig.name_in_configuration()
        await self._read_anew()
        return {
            "subject": subject.as_json(),
            "lengths": lengths_of(body),
            "file": str(self._rig.target),
        }

    def _begin(self, request: BeginCalibrationRequest) -> dict[str, Any]:
        self._cancel()
        self._session = BodySession(self._pipeline.suit, request.field)
        self._pipeline.module_stage.on_frame = self._session.add
        self._phase = "ready"
        return {"steps": _steps_message(self._session)}

    def _needed(self) -> BodySession:
        if self._session is None:
            raise GatewayError("no calibration is under way: ask for calibration/begin first")
        return self._session

    async def _step(self, request: CalibrationStepRequest) -> dict[str, Any]:
        session = self._needed()
        step = session.step(request.step)
        if self._running is not None and not self._running.done():
            raise GatewayError(
                f"step '{session.current or request.step}' is under way: wait until it is done"
            )
        await _wait_for_frames(session)
        seconds = step.seconds if request.seconds is None else request.seconds
        self._result = None
        self._running = asyncio.create_task(
            self._do(session, request, seconds), name=f"calibration {step.name}"
        )
        return {"step": step.name, "countdown_s": request.countdown_s, "seconds": seconds}

    async def _do(self, session: BodySession, request: CalibrationStepRequest, seconds: float) -> None:
        loop = asyncio.get_running_loop()
        self._phase, self._ends_at = f"get ready for {request.step}", loop.time() + request.countdown_s
        await asyncio.sleep(request.countdown_s)
        session.begin(request.step, request.segments)
        self._phase, self._ends_at = f"recording {request.step}", loop.time() + seconds
        await asyncio.sleep(seconds)
        session.end()
        self._phase = "ready"

    def _status(self, _request: Request) -> dict[str, Any]:
        if self._session is None:
            return {"phase": "idle"}

        is_busy = self._running is not None and not self._running.done()
        left = max(self._ends_at - asyncio.get_running_loop().time(), 0.0) if is_busy else 0.0
        names = {self._pipeline.suit.module_of_segment[s]: n for s, n in self._named()}
        return {
            "phase": self._phase,
            "left_s": round(left, 1),
            "done": self._session.done,
            "steps": _steps_message(self._session),
            "modules": [
                {
                    "segment": names[m],
                    "heard": one.is_received,
                    "still": one.is_received and one.turning < STILL,
                    "turning_deg_s": round(float(np.degrees(one.turning)), 1),
                }
                for m, one in enumerate(self._session.live())
            ],
        }

    def _named(self) -> list[tuple[int, str]]:
        return list(enumerate(self._pipeline.suit.skeleton.segment_names))

    async def _find_result(self, _request: Request | None = None) -> dict[str, Any]:
        session = self._needed()
        if self._running is not None and not self._running.done():
            raise GatewayError(f"{self._phase}: wait until the step is done")
        self._result = await asyncio.to_thread(session.result)
        return self._result.as_json()

    async def _accept(self, request: AcceptCalibrationRequest) -> dict[str, Any]:
        if self._result is None:
            await self._find_result()
        assert self._result is not None
        accepted = self._result.accepted(request.segments, request.poor)
        if not accepted:
            raise GatewayError("nothing in the result is good enough to be used: see calibration/result")
        await self._wear(mounting_event(accepted))
        answer: dict[str, Any] = {"accepted": [module.segment for module in accepted]}
        if request.save:
            target = self._rig.target
            kept = write_mounted_rig(self._rig.source, target, accepted)
            answer |= {"file": str(target), "earlier": None if kept is None else str(kept)}
            answer["is_configured"] = self._rig.name_in_configuration()
        self._cancel()
        return answer

    def _cancel(self, _request: Request | None = None) -> dict[str, Any]:
        if self._running is not None:
            self._running.cancel()
        self._running, self._session, self._result = None, None, None
        self._pipeline.module_stage.on_frame = None
        self._phase = "idle"
        return {}

    def _history(self, _request: Request) -> dict[str, Any]:
        target = self._rig.target
        return {"file": str(target), "versions": [path.stem for path in history(target)]}

    async def _restore(self, request: RestoreCalibrationRequest) -> dict[str, Any]:
        target = self._rig.target
        version = restore(target, request.version)
        await self._wear(mounting_event(_as_modules(load_rig(str(target)))))
        return {"file": str(target), "version": version.stem}


async def _wait_for_frames(session: BodySession) -> None:
    """Wait until there is a frame. Raises ``GatewayError`` if there is none within ``FIRST_FRAME_S``."""
    loop = asyncio.get_running_loop()
    ends_at = loop.time() + FIRST_FRAME_S
    while not session.now_ns and loop.time() < ends_at:  # noqa: ASYNC110 - polled
        await asyncio.sleep(0.05)
    session.refuse_without_frames()


def _steps_message(session: BodySession) -> list[dict[str, Any]]:
    """Return its steps, for a client that begins it or goes on with it."""
    return [
        {"step": s.name, "kind": s.kind.value, "seconds": s.seconds, "instruction": s.instruction}
        for s in session.steps
    ]


def _as_modules(suit: WornSuit) -> list[ModuleResult]:
    """Return how a rig file says that modules sit."""
    return [
        ModuleResult(
            suit.module_ids[row],
            suit.skeleton.segment_names[s],
            Quality(1.0),
            suit.sensor_to_segment[s],
            suit.lever_arms[s],
            0.0,
            0.0,
        )
        for s, row in enumerate(suit.module_of_segment.tolist())
        if row >= 0
    ]
