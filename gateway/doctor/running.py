"""Ask a gateway that runs: is it online, how do its modules and their clocks fare."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator, Mapping

from pydantic import ValidationError

from gateway.contract.messages import BridgeState, ModuleState
from gateway.contract.topics import BRIDGE_STATE, Topics
from gateway.doctor.findings import Finding, bad, good, warning
from gateway.outputs.connection import broker_connection, unique_identifier
from gateway.outputs.settings import MqttSettings

LONGEST_DELAY_US = 5000.0
"""Mean delay of arrivals above the least, beyond which a module's data come in clumps."""
MOST_PPM = 100.0
MOST_LOST = 0.01
_RETAINED_S = 0.7


async def module_states(settings: MqttSettings, gateway: str) -> dict[int, ModuleState] | None:
    """Return the states of a running gateway's modules; None: no such gateway runs, as far as can be seen."""
    if settings.broker == "embedded" and settings.port == 0:
        return None
    topics = Topics(settings.base_topic, gateway)
    states: dict[int, ModuleState] = {}
    is_online = False
    with contextlib.suppress(Exception):  # what is wrong with the broker is a finding of its own
        async with broker_connection(settings, settings.port, unique_identifier("doctor")) as client:
            await client.subscribe([(topics.bridge_state, 1), (f"{topics.root}/module/+/state", 1)])
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_RETAINED_S):
                    async for message in client.messages:
                        address = topics.split(message.topic.value)
                        if address is None:
                            continue
                        with contextlib.suppress(ValidationError):
                            if address[1] == BRIDGE_STATE:
                                is_online = BridgeState.model_validate_json(message.payload).state == "online"
                            else:
                                state = ModuleState.model_validate_json(message.payload)
                                states[state.module] = state
    return states if is_online else None


def judge(gateway: str, states: Mapping[int, ModuleState]) -> Iterator[Finding]:
    """Yield findings about a running gateway."""
    yield good("gateway", f"'{gateway}' is online, with {len(states)} modules")
    silent = [_named(state) for state in states.values() if state.availability == "offline"]
    if silent:
        remedy = "switch them on, check battery and plug; mocap-gateway modules list shows who answers"
        yield bad("modules: heard", f"silent: {', '.join(silent)}", remedy)
    lossy = [
        f"{_named(state)} {state.lost / (state.lost + state.received):.1%}"
        for state in states.values()
        if state.lost > MOST_LOST * (state.lost + state.received)
    ]
    if lossy:
        remedy = "see capacity above; a lower sampling rate, shorter cables, a nearer receiver"
        yield warning("modules: loss", f"packets are lost: {', '.join(lossy)}", remedy)
    restarted = [f"{_named(state)} {state.resets} times" for state in states.values() if state.resets]
    if restarted:
        yield warning(
            "modules: restarts", f"restarted: {', '.join(restarted)}", "check battery, power and plugs"
        )
    for state in states.values():
        if state.doubt is not None:
            found, _, remedy = state.doubt.partition(": ")
            yield warning("modules: doubtful", f"{_named(state)}: {found}", remedy)
    yield from _clocks(states)


def _clocks(states: Mapping[int, ModuleState]) -> Iterator[Finding]:
    known = {number: state.clock for number, state in states.items() if state.clock is not None}
    if not known:
        return
    delayed = [
        f"{number} {clock.residual_us / 1000:.1f} ms"
        for number, clock in known.items()
        if clock.residual_us > LONGEST_DELAY_US
    ]
    if delayed:
        remedy = "latency_timer of the adapter to 1 ms; a busy host or radio does the same"
        yield warning("clocks", f"data of modules come late, in clumps: {', '.join(delayed)}", remedy)
    fast = [
        f"{number} {clock.ppm:+.0f} ppm"
        for number, clock in known.items()
        if clock.ppm is not None and abs(clock.ppm) > MOST_PPM
    ]
    if fast:
        remedy = "check that the firmware's microseconds are microseconds; the gateway corrects the rest"
        yield warning("clocks", f"crystals far off: {', '.join(fast)}", remedy)
    if not delayed and not fast:
        settled = sum(clock.state == "settled" for clock in known.values())
        worst = max(clock.residual_us for clock in known.values())
        found = f"{settled} of {len(known)} settled; arrivals {worst / 1000:.2f} ms late in the mean at most"
        yield good("clocks", found)


def _named(state: ModuleState) -> str:
    return f"{state.module} ({state.segment})" if state.segment else str(state.module)
