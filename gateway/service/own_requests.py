"""Requests about the gateway itself: ``gateway/info``, ``health``, ``reload``, ``examine``, ``connect``,
``configure``, ``confirm``."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from gateway.contract.requests import ConfigureRequest, ConfirmRequest, ConnectRequest, asked
from gateway.errors import GatewayError
from gateway.outputs.mqtt import MqttOutput

Reload = Callable[[], Awaitable[None]]
Examine = Callable[[], Awaitable[dict[str, Any]]]
Connect = Callable[[ConnectRequest], Awaitable[dict[str, Any]]]
Configure = Callable[[ConfigureRequest], Awaitable[dict[str, Any]]]
Confirm = Callable[[ConfirmRequest], Awaitable[dict[str, Any]]]
_NO_FILE = "this gateway has no configuration file {}: start it with `mocap-gateway run -c FILE`"


class OwnRequests:
    """Answers them, any number at once; belongs to one running service."""

    def __init__(self, mqtt: MqttOutput) -> None:
        self.on_reload: Reload | None = None
        """Reads the configuration; raises ``GatewayError`` for a wrong one. None: there is no file of it."""
        self.on_examine: Examine | None = None
        """What the doctor finds of this gateway. None: nobody is there to look."""
        self.on_connect: Connect | None = None
        """Has a link use another port. None: there is no file of the configuration."""
        self.on_configure: Configure | None = None
        """Takes other settings into use. None: there is no file of the configuration."""
        self.on_confirm: Confirm | None = None
        """Keeps them."""
        self._mqtt = mqtt
        self._reloading = asyncio.Lock()

    async def perform(self, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Answer one request about the gateway. Raises ``GatewayError`` that names the remedy."""
        request = asked("gateway", verb, data)
        if isinstance(request, ConnectRequest):
            return await self._connect(request)
        if isinstance(request, ConfigureRequest):
            return await self._configure(request)
        if isinstance(request, ConfirmRequest):
            if self.on_confirm is None:
                raise GatewayError(_NO_FILE.format("to change"))
            return await self.on_confirm(request)
        if verb == "reload":
            return await self._reload()
        if verb == "examine":
            if self.on_examine is None:
                raise GatewayError("this gateway cannot be examined from within: use `mocap-gateway doctor`")
            return await self.on_examine()
        message = self._mqtt.info if verb == "info" else self._mqtt.health()
        return message.model_dump(mode="json")

    async def _connect(self, request: ConnectRequest) -> dict[str, Any]:
        if self.on_connect is None:
            raise GatewayError(_NO_FILE.format("to change"))
        async with self._reloading:
            return await self.on_connect(request)

    async def _configure(self, request: ConfigureRequest) -> dict[str, Any]:
        if self.on_configure is None:
            raise GatewayError(_NO_FILE.format("to change"))
        async with self._reloading:
            return await self.on_configure(request)

    async def _reload(self) -> dict[str, Any]:
        if self.on_reload is None:
            raise GatewayError(_NO_FILE.format("to read anew"))
        async with self._reloading:
            await self.on_reload()
        return {"reloaded": True}
