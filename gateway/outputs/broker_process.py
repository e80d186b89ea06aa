"""The embedded broker seen from the gateway: a child process, kept alive and ended reliably."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Sequence

from gateway.errors import OutputError
from gateway.outputs.connection import broker_back_off
from gateway.outputs.settings import WEBSOCKET_TOKEN_VARIABLE
from gateway.support.credentials import AccessToken

logger = logging.getLogger(__name__)

_START_TIMEOUT_S = 10.0
_STOP_TIMEOUT_S = 1.5


class EmbeddedBrokerError(OutputError):
    """The embedded broker did not start. ``str(error)`` says why and what would do."""


class BrokerProcess:
    """Runs ``gateway.outputs.embedded_broker``; starts it again, with a warning, when it dies.

    port: 0 takes any free one; after ``start`` the attribute ``port`` names it.
    websocket_port: also listen for WebSocket clients there, from these origins beside this machine's.
    token: what such a client shows as its password to publish; None: it can only listen.
    """

    def __init__(
        self,
        port: int,
        websocket_port: int | None = None,
        websocket_origins: Sequence[str] = (),
        token: AccessToken | None = None,
    ) -> None:
        self.port = port
        self.websocket_port = websocket_port
        self._websocket_origins = tuple(websocket_origins)
        self._token = token
        self.asked = (
            port,
            websocket_port,
            self._websocket_origins,
            None if token is None else token.reveal(),
        )
        """As given: where they are equal, one broker can stand for another."""
        self._process: asyncio.subprocess.Process | None = None
        self._supervisor: asyncio.Task[None] | None = None

    @property
    def pid(self) -> int | None:
        """Process id of the running broker."""
        return self._process.pid if self._process is not None else None

    async def start(self) -> None:
        """Start it and wait until it listens. Raises ``EmbeddedBrokerError``."""
        process = await self._launch()
        self._supervisor = asyncio.create_task(self._keep_alive(process), name="embedded broker")

    async def stop(self) -> None:
        """End it: politely, then by force."""
        if self._supervisor is not None:
            self._supervisor.cancel()
            await asyncio.gather(self._supervisor, return_exceptions=True)
            self._supervisor = None
        if self._process is not None:
            await _end(self._process)
            self._process = None

    async def _launch(self) -> asyncio.subprocess.Process:
        command = [sys.executable, "-m", "gateway.outputs.embedded_broker", "--port", str(self.port)]
        if self.websocket_port is not None:
            command += ["--websocket-port", str(self.websocket_port)]
        for origin in self._websocket_origins:
            command += ["--websocket-origin", origin]
        environment = {name: value for name, value in os.environ.items() if name != WEBSOCKET_TOKEN_VARIABLE}
        if self._token is not None:
            environment[WEBSOCKET_TOKEN_VARIABLE] = self._token.reveal()
        # A session of its own keeps Ctrl-C in a terminal from ending the broker before the gateway
        # has said goodbye. The pipe to its standard input is its lifeline: it ends when that closes,
        # however the gateway died.
        process = await asyncio.create_subprocess_exec(
            *command,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            start_new_session=True,
            env=environment,
        )
        self._process = process
        try:
            async with asyncio.timeout(_START_TIMEOUT_S):
                assert process.stdout is not None
                answer = (await process.stdout.readline()).decode().strip()
        except TimeoutError:
            answer = f"it did not answer within {_START_TIMEOUT_S:.0f} s"
        except asyncio.CancelledError:
            await _end(process)
            raise
        word, _, number = answer.partition(" ")
        if word != "listening":
            await _end(process)
            raise EmbeddedBrokerError(f"the embedded broker did not start: {answer or 'see the lines above'}")
        self.port = int(number)
        return process

    async def _keep_alive(self, process: asyncio.subprocess.Process) -> None:
        back_off = broker_back_off()
        while True:
            code = await process.wait()
            logger.warning("the embedded broker ended (exit code %d): starting it again", code)
            back_off.reset()
            restarted = None
            while restarted is None:
                await asyncio.sleep(back_off.next_delay())
                try:
                    restarted = await self._launch()
                except (EmbeddedBrokerError, OSError) as error:
                    logger.warning("%s; trying again", error)
            process = restarted


async def _end(process: asyncio.subprocess.Process) -> None:
    if process.stdin is not None:
        process.stdin.close()
    try:
        async with asyncio.timeout(_STOP_TIMEOUT_S):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()
