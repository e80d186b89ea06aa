"""``mocap-gateway video serve-camera``: the heat maps of a camera, for a gateway on another machine."""

from __future__ import annotations

from typing import Annotated

import typer

from gateway.cameras.camera_process import CameraTask
from gateway.cameras.serving import serve
from gateway.cli.video_sources import Network, Rate


def serve_camera(
    place: Annotated[str, typer.Argument(help="Video, folder of images, or v4l:///dev/video0.")],
    name: Annotated[str, typer.Option(help="Of the camera, as the calibration has it.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0: any that is free.")] = 9765,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 for all.")] = "127.0.0.1",
    network: Network = "full",
    rate: Rate = None,
    speed: Annotated[float, typer.Option(min=0, help="Of a file: 1 as taken; 0 as fast as it goes.")] = 1.0,
) -> None:
    """Serve the heat maps of one camera over TCP to a gateway elsewhere; no picture leaves here.

    Every gateway that connects gets the messages from then on. In its configuration the link is
    url: tcp://HOST:PORT, carries: heat_maps.
    """
    done = serve(
        CameraTask(name, place, network, rate), host, port, speed, lambda text: typer.echo(text, err=True)
    )
    typer.echo(f"{done.messages} pictures, {done.sent} messages sent, {done.skipped} left out")
