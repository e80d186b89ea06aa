"""Settings that the fleet pushes: shown before they count, and gone again unless somebody confirms them.

They lie in a file beside the configuration (``gateway.fleet.yaml`` beside ``gateway.yaml``), which itself is
never written to. What was there before is kept until they are confirmed; a gateway that was not confirmed in
time, or that is started again before, goes back to it.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import logging
import os
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from gateway.body.rig import load_rig
from gateway.contract.requests import ConfigureRequest, ConfirmRequest
from gateway.errors import GatewayError
from gateway.settings import (
    GatewaySettings,
    fitting_suit,
    load_gateway_settings,
    pushed_file,
    pushed_settings,
)
from gateway.support.whole_files import write_whole, writing

log = logging.getLogger(__name__)

_NEVER = ("recording.folder",)
"""Not even where the section is allowed: where files go is for those who have the computer."""
_TRIES = 10
_TRY_AGAIN_S = 2.0


def _before_file(config: Path) -> Path:
    return pushed_file(config).with_suffix(".before")


def _journal_file() -> Path:
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "mocap-gateway" / "configuration_changes.jsonl"


def go_back_if_unconfirmed(config: Path) -> bool:
    """Take back what was pushed and never confirmed, before a start. Returns whether there was any."""
    if not _before_file(config).exists():
        return False
    _restore(config)
    _note("taken back at the next start", {})
    return True


def _restore(config: Path) -> None:
    before, pushed = _before_file(config), pushed_file(config)
    with writing(pushed):
        if before.read_bytes():
            before.replace(pushed)
        else:
            pushed.unlink(missing_ok=True)
            before.unlink()


def _note(what: str, details: Mapping[str, Any]) -> None:
    """Write a line into the journal of changes, and into the log."""
    log.warning("settings pushed from the fleet: %s %s", what, json.dumps(details) if details else "")
    path = _journal_file()
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"utc_ns": time.time_ns(), "what": what, **details}) + "\n")


class RemoteConfiguration:
    """Obeys ``gateway/configure`` and ``gateway/confirm``; outlives the services of one process."""

    def __init__(self, config: Path, read_anew: Callable[[], Awaitable[None]]) -> None:
        """read_anew: lets the service of the changed file take over; raises ``GatewayError``."""
        self._config = config
        self._read_anew = read_anew
        self._token: str | None = None
        self._going_back: asyncio.Task[None] | None = None

    async def configure(self, request: ConfigureRequest) -> dict[str, Any]:
        """Show, or take into use, other settings. Raises ``GatewayError`` with what stands against them."""
        now, pushed = load_gateway_settings(self._config), dict(pushed_settings(self._config))
        for name, value in request.settings.items():
            _refuse(name, value, now)
            _set(pushed, name.split("."), value)
        then = load_gateway_settings(self._config, pushed)
        fitting_suit(then, await asyncio.to_thread(load_rig, then.rig, self._config))
        differences = _differences(now, then, request.settings)
        if request.dry_run or not differences:
            return {"applied": False, "differences": differences}
        if self._token is not None:
            raise GatewayError("another change waits to be confirmed: ask again when that is done")
        await self._apply(pushed, differences)
        self._token = secrets.token_hex(16)
        self._going_back = asyncio.create_task(self._go_back_after(request.confirm_within_s), name="go back")
        return {
            "applied": True,
            "differences": differences,
            "token": self._token,
            "confirm_within_s": request.confirm_within_s,
        }

    async def confirm(self, request: ConfirmRequest) -> dict[str, Any]:
        """Keep what was taken into use. Raises ``GatewayError`` where nothing waits for it."""
        if self._token is None or not hmac.compare_digest(self._token, request.token):
            raise GatewayError("no change waits to be confirmed with this token: it was taken back already?")
        assert self._going_back is not None
        self._going_back.cancel()
        self._token = None
        _before_file(self._config).unlink(missing_ok=True)
        _note("confirmed", {})
        return {"confirmed": True}

    async def _apply(self, pushed: Mapping[str, Any], differences: list[dict[str, Any]]) -> None:
        """Write the file and have it read; it is as before where that fails."""
        file = pushed_file(self._config)
        with writing(file):
            write_whole(_before_file(self._config), file.read_bytes() if file.exists() else b"")
            write_whole(file, yaml.safe_dump(dict(pushed), allow_unicode=True).encode())
        try:
            _note("taken into use until confirmed", {"differences": differences})
            await self._read_anew()
        except GatewayError:
            _restore(self._config)
            raise

    async def _go_back_after(self, seconds: float) -> None:
        await asyncio.sleep(seconds)
        self._token = None
        _restore(self._config)
        _note(f"taken back, nobody confirmed them within {seconds:g} s", {})
        for _ in range(_TRIES):
            with contextlib.suppress(GatewayError):
                await self._read_anew()
                return
            await asyncio.sleep(_TRY_AGAIN_S)
        log.error("the settings from before could not be taken into use: start the gateway anew")


def _refuse(name: str, value: object, settings: GatewaySettings) -> None:
    """Raise ``GatewayError`` for a setting that is not the fleet's to change."""
    section = name.partition(".")[0]
    allowed = settings.allow_configuration
    if section not in allowed or name in _NEVER or name == "recording":
        what = f"only {', '.join(allowed)}" if allowed else "none"
        raise GatewayError(
            f"{name} is not for others to change (allow_configuration in this gateway's file: {what}"
            + (f"; never {name})" if name in _NEVER else ")")
        )
    if isinstance(value, dict):
        raise GatewayError(f"{name}: name single settings, such as {name}.…")


def _set(pushed: dict[str, Any], place: list[str], value: object) -> None:
    """Set a value at a place in nested mappings; None takes it away."""
    *sections, last = place
    for section in sections:
        inner = pushed.setdefault(section, {})
        if not isinstance(inner, dict):
            raise GatewayError(f"{'.'.join(place)}: {section} holds no named settings")
        pushed = inner
    if value is None:
        pushed.pop(last, None)
    else:
        pushed[last] = value


def _differences(
    now: GatewaySettings, then: GatewaySettings, names: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return what a change means, for each setting that is another one afterwards."""
    before, after = now.model_dump(mode="json"), then.model_dump(mode="json")
    found = []
    for name in names:
        old, new = _at(before, name), _at(after, name)
        if old != new:
            found.append({"setting": name, "before": old, "after": new})
    return found


def _at(value: Any, name: str) -> Any:
    for step in name.split("."):
        value = value.get(step) if isinstance(value, dict) else None
    return value
