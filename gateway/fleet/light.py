"""Light gateways: they publish as any gateway does, poses that were made beforehand; to try and measure.

``python -m gateway.fleet.light PLAN.json`` runs some of them in one process, until it is terminated.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import gateway
from devices.link import LinkError, gateway_time_ns
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import BridgeInfo, UtcAnchor
from gateway.emulation.simulation import suit_17
from gateway.errors import GatewayError
from gateway.frames import SkeletonFrame
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings
from gateway.recording import open_recording
from gateway.support.settings_files import Strict

_SIMULATED_S = 10.0
_MB = 1e6
_LONGEST_LAG_S = 0.2


class LightGateway(Strict):
    """One of them."""

    name: str
    mqtt: MqttSettings


class LightPlan(Strict):
    """Those of one process."""

    gateways: tuple[LightGateway, ...]
    rate_hz: float
    recording: Path | None = None
    """Whose poses they publish; none: those of a simulated person."""


def poses_of(plan: LightPlan) -> tuple[Skeleton, list[SkeletonFrame], str]:
    """Return a body, its poses, and the method they were made by. Raises ``GatewayError``."""
    if plan.recording is None:
        suit, motion = suit_17()
        times = np.arange(round(_SIMULATED_S * plan.rate_hz)) / plan.rate_hz
        state = motion.state(times)
        n = suit.skeleton.n_segments
        frames = [
            SkeletonFrame(
                sequence=k,
                time_ns=0,
                q_wb=state.q_wb[k].astype(np.float64),
                angular_rate=state.angular_rate[k].astype(np.float64),
                joint_acceleration=state.joint_acceleration[k].astype(np.float64),
                p_w=state.joint_position[k].astype(np.float64),
                sigma=np.full(n, np.nan),
                status=np.zeros(n, np.uint8),
                root=0,
            )
            for k in range(len(times))
        ]
        return suit.skeleton, frames, "simulated"
    recording = open_recording(plan.recording)
    frames = list(recording.skeleton_frames())
    if not frames:
        raise GatewayError(f"{plan.recording} has no poses: replay it with --with first, or name another")
    return recording.meta.skeleton, frames, recording.meta.settings.reconstructor


async def run(plan: LightPlan) -> None:
    """Publish until cancelled."""
    skeleton, frames, method = poses_of(plan)
    async with contextlib.AsyncExitStack() as stack:
        outputs = []
        for each in plan.gateways:
            info = BridgeInfo(
                version=gateway.__version__,
                gateway=each.name,
                reconstructor=method,
                frame_rate=plan.rate_hz,
            )
            output = MqttOutput(each.mqtt, skeleton, info, health=_disk)
            output.anchor(_utc(), is_step=True)
            outputs.append(await stack.enter_async_context(output))
        await _offer(outputs, frames, plan.rate_hz)


def _utc() -> UtcAnchor:
    own_ns, utc_ns = gateway_time_ns(), time.time_ns()
    return UtcAnchor(t_ns=own_ns, utc_ns=utc_ns, offset_ns=utc_ns - own_ns, steps=0)


def _disk() -> dict[str, object]:
    return {"recording": {"state": "off", "free_mb": round(shutil.disk_usage(Path.cwd()).free / _MB)}}


async def _offer(outputs: Sequence[MqttOutput], frames: Sequence[SkeletonFrame], rate_hz: float) -> None:
    """Offer a pose to each of them at the rate, one after another within the time of a pose."""
    loop = asyncio.get_running_loop()
    begun, step = loop.time(), 1.0 / rate_hz / len(outputs)
    for count in range(sys.maxsize):
        round_, which = divmod(count, len(outputs))
        due = begun + count * step
        wait = due - loop.time()
        if wait < -_LONGEST_LAG_S:
            begun -= wait  # delayed: those poses were never made, and are not made all at once
        if wait > 0:
            await asyncio.sleep(wait)
        elif which == 0:
            await asyncio.sleep(0)
        frame = frames[(round_ + 7 * which) % len(frames)]
        outputs[which].offer(replace(frame, sequence=round_, time_ns=gateway_time_ns()))


async def _until_terminated(plan: LightPlan) -> None:
    task = asyncio.ensure_future(run(plan))
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await task


def main(arguments: Sequence[str]) -> None:
    """Run the plan that a file holds."""
    plain: Any = json.loads(Path(arguments[0]).read_text(encoding="utf-8"))
    try:
        asyncio.run(_until_terminated(LightPlan.model_validate(plain)))
    except (GatewayError, LinkError) as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(sys.argv[1:])
