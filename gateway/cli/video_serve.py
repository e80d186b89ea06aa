"""``mocap-gateway video serve-camera``: the heat maps of a camera, for a gateway on another machine."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Annotated

import typer

from gateway.cameras.broker_link import TOPIC
from gateway.cameras.broker_outlet import BrokerOutlet
from gateway.cameras.camera_process import CameraTask
from gateway.cameras.serving import Outlet, Sink, listening, serve
from gateway.cli.broker_options import CaFile, PasswordFile, Protocol, Username, broker_settings
from gateway.cli.video_sources import Network, Rate
from gateway.errors import GatewayError
from gateway.support.video_extra import require_video_extra

_DAY_S = 86_400


def serve_camera(
    place: Annotated[
        str,
        typer.Argument(help="Video, folder, v4l:///dev/video0, or recording of `solve`."),
    ],
    name: Annotated[str, typer.Option(help="Of the camera, as the calibration has it.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0: any that is free.")] = 9765,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 for all.")] = "127.0.0.1",
    network: Network = "full",
    rate: Rate = None,
    speed: Annotated[float, typer.Option(min=0, help="Of a file: 1 as taken; 0 as fast as it goes.")] = 1.0,
    at: Annotated[
        str | None,
        typer.Option(metavar="HH:MM:SS", help="When a file begins, UTC; else with the first receiver."),
    ] = None,
    mqtt: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Publish at this broker in the place of TCP.")
    ] = None,
    topic: Annotated[
        str | None, typer.Option(help=f"At the broker; default {TOPIC.format(camera='NAME')}.")
    ] = None,
    username: Username = None,
    password_file: PasswordFile = None,
    protocol: Protocol = "3.1.1",
    ca_file: CaFile = None,
) -> None:
    """Serve the heat maps of one camera over TCP or MQTT to a gateway elsewhere; no picture leaves here.

    Every gateway that connects gets the messages from then on. In its configuration the link is
    url: tcp://HOST:PORT, or mqtt:///TOPIC at its own broker, with carries: heat_maps. Files of several
    cameras keep together when all begin --at the same time. Of a recording the heat maps are served as they
    are, without pictures or network.
    """
    require_video_extra()
    begin_s = None if at is None else moment(at, time.time())
    task = CameraTask(name, place, network, rate)
    if mqtt is None:
        with listening(host, port) as listener:
            _say(f"camera '{name}' at tcp://{host}:{listener.getsockname()[1]}; Ctrl-C ends")
            _serve(task, Outlet(listener), speed, begin_s)
        return
    broker, _, number = mqtt.rpartition(":")
    if not broker or not number.isdigit() or not 0 < int(number) < 1 << 16:
        raise GatewayError(f"--mqtt {mqtt}: write HOST:PORT, such as 127.0.0.1:1883")
    topic = topic or TOPIC.format(camera=name)
    if set(topic) & set("+#\0"):
        raise GatewayError(f"--topic {topic}: + and # stand for other topics, and cannot be published on")
    settings = broker_settings(
        ca_file, host=broker, port=int(number), username=username, password_file=password_file,
        protocol=protocol,
    )  # fmt: skip
    _say(f"camera '{name}' on topic {topic} of {mqtt}; Ctrl-C ends")
    _serve(task, BrokerOutlet(settings, topic), speed, begin_s)


def _serve(task: CameraTask, sink: Sink, speed: float, begin_s: float | None) -> None:
    serve(task, sink, speed, begin_s)
    done = sink.served
    typer.echo(f"{done.messages} pictures, {done.sent} messages sent, {done.skipped} left out")


def _say(text: str) -> None:
    typer.echo(text, err=True)


def moment(text: str, now_s: float) -> float:
    """The next time that it is so late in UTC, within twelve hours; seconds since the epoch. Raises
    ``GatewayError``."""
    try:
        wanted = datetime.strptime(text, "%H:%M:%S").replace(tzinfo=UTC)
    except ValueError as error:
        raise GatewayError(f"--at {text}: a time of day in UTC is wanted, such as 09:30:00") from error
    ahead_s = (wanted.hour * 3600 + wanted.minute * 60 + wanted.second - now_s) % _DAY_S
    if ahead_s > _DAY_S / 2:
        now = datetime.fromtimestamp(now_s, UTC)
        raise GatewayError(f"--at {text}: has passed; it is {now:%H:%M:%S} UTC")
    return now_s + ahead_s
