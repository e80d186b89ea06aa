"""Poses live in Foxglove: a server on a WebSocket, by the library of Foxglove (extra ``foxglove``)."""

from __future__ import annotations

import importlib
from typing import Any

from gateway.body.skeleton import Skeleton
from gateway.contract.foxglove_messages import ANGLES, SCENE, TRANSFORMS, FoxgloveEncoder
from gateway.errors import GatewayError, OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.settings import FoxgloveSettings

_SCENE_EVERY_NS = 1_000_000_000
"""Who connects later sees the bones after so long."""
_BACKLOG = 16
"""Messages kept for a client that is slow; then the oldest is dropped."""


class FoxgloveSink:
    """A server for any number of clients. What a slow one does not take is dropped for it alone."""

    def __init__(self, settings: FoxgloveSettings, skeleton: Skeleton, gateway: str) -> None:
        self._settings = settings
        self._skeleton = skeleton
        self._gateway = gateway
        self._server: Any = None
        self._scene_due_ns = 0

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.port)

    async def open(self) -> None:
        """Begin to listen. Raises ``OutputError`` without the extra, or where it cannot listen."""
        try:
            self._encoder = FoxgloveEncoder(self._skeleton)
        except GatewayError as error:
            raise OutputError(f"outputs.foxglove: {error}") from error
        library, channels = importlib.import_module("foxglove"), importlib.import_module("foxglove.channels")
        self._context = context = library.Context()  # it must live as long as the server
        try:
            self._server = library.start_server(
                name=f"mocap-gateway {self._gateway}",
                host=self._settings.host,
                port=self._settings.port,
                context=context,
                message_backlog_size=_BACKLOG,
            )
        except Exception as error:
            where = f"{self._settings.host}:{self._settings.port}"
            raise OutputError(
                f"outputs.foxglove: cannot listen on {where} ({error}): choose another port or host"
            ) from error
        self._transforms = channels.FrameTransformsChannel(TRANSFORMS, context=context)
        self._scene = channels.SceneUpdateChannel(SCENE, context=context)
        self._angles = None
        if self._skeleton.joints:
            self._angles = library.Channel(ANGLES, schema=self._encoder.angles_schema(), context=context)
        self._scene_due_ns = 0

    def send(self, frame: SkeletonFrame) -> bool:
        """Hand over a pose; the library keeps it for every client."""
        time_ns = frame.time_ns
        if not time_ns < self._scene_due_ns <= time_ns + _SCENE_EVERY_NS:
            self._scene.log(self._encoder.scene(time_ns), log_time=time_ns)
            self._scene_due_ns = time_ns + _SCENE_EVERY_NS
        self._transforms.log(self._encoder.transforms(time_ns, frame.q_wb, frame.p_w), log_time=time_ns)
        if self._angles is not None:
            self._angles.log(self._encoder.angles(frame.q_wb), log_time=time_ns)
        return True

    def close(self) -> None:
        """End the server."""
        if self._server is not None:
            self._server.stop()
            self._server = None
