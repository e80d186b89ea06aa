"""Settings pushed to gateways: first shown, then taken into use one gateway after another, each confirmed."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Mapping
from typing import Any

import yaml

from gateway.errors import GatewayError
from gateway.modules.remote import RemoteOperations, remote_suit
from gateway.outputs.settings import MqttSettings
from gateway.support import yaml_text

_ANSWER_S = 10.0
_ASK_AGAIN_S = 0.5


def settings_of(given: list[str]) -> dict[str, Any]:
    """Return NAME=VALUE as settings, each value as in YAML. Raises ``GatewayError``."""
    found = {}
    for each in given:
        name, sign, value = each.partition("=")
        try:
            found[name.strip()] = yaml_text.load(value)
        except yaml.YAMLError:
            sign = ""
        if not sign or not name.strip():
            raise GatewayError(f"--set {each}: NAME=VALUE is wanted, such as recording.rotate_minutes=30")
    return found


async def _request(
    remote: RemoteOperations, gateway: str, verb: str, data: Mapping[str, Any]
) -> dict[str, Any]:
    try:
        async with asyncio.timeout(_ANSWER_S):
            return dict(await remote.perform(verb, data))
    except TimeoutError:
        raise GatewayError(
            f"gateway '{gateway}' did not answer within {_ANSWER_S:.0f} s: is it online (`fleet list`), "
            "and may this user ask it (operator may)?"
        ) from None


async def differences(
    settings: MqttSettings, gateway: str, wanted: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return what settings would change at one gateway: setting, before, after. Raises ``GatewayError``."""
    async with remote_suit(settings, gateway, "gateway") as remote:
        answer = await _request(remote, gateway, "configure", {"settings": wanted, "dry_run": True})
    return list(answer["differences"])


async def push(settings: MqttSettings, gateway: str, wanted: Mapping[str, Any], within_s: float) -> bool:
    """Have one gateway take settings into use, and confirm them once it has come back.

    within_s: after so long it goes back by itself. Returns whether anything changed. Raises ``GatewayError``
    where it refuses them, or does not come back.
    """
    async with remote_suit(settings, gateway, "gateway") as remote:
        before = await _request(remote, gateway, "health", {})
        request = {"settings": wanted, "dry_run": False, "confirm_within_s": within_s}
        begun_s = time.monotonic()
        answer = await _request(remote, gateway, "configure", request)
    if not answer["applied"]:
        return False
    while time.monotonic() - begun_s < within_s:
        with contextlib.suppress(GatewayError):
            async with remote_suit(settings, gateway, "gateway") as remote:
                now = await _request(remote, gateway, "health", {})
                if _is_back(before, now):
                    await _request(remote, gateway, "confirm", {"token": answer["token"]})
                    return True
        await asyncio.sleep(_ASK_AGAIN_S)
    raise GatewayError(
        f"gateway '{gateway}' did not come back within {within_s:g} s: it goes back to its earlier "
        "settings by itself; its log says why"
    )


def _is_back(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Return whether another run of a gateway answers, which publishes poses if the one before did."""
    has_poses = now["mqtt"]["published"] > 0 or before["mqtt"]["published"] == 0
    return bool(has_poses and now["instance"] != before["instance"])
