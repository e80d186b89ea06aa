"""``mocap-gateway calibrate``: everything that is measured before a capture."""

from __future__ import annotations

import typer

from gateway.cli.calibrate_body import body, put_back, versions
from gateway.cli.calibrate_cameras import cameras
from gateway.cli.calibrate_clocks import clocks
from gateway.cli.calibrate_sensors import sensors

calibrate_app = typer.Typer(help="Measure what has to be known before a capture.", no_args_is_help=True)
calibrate_app.command(epilog="Example: mocap-gateway calibrate clocks -c config/gateway.yaml --minutes 60")(
    clocks
)
calibrate_app.command(
    epilog="Example: mocap-gateway calibrate sensors --link /dev/ttyUSB0 --rig suit_17 -o mine.yaml"
)(sensors)
calibrate_app.command(
    epilog="Examples: mocap-gateway calibrate body -c my.yaml; "
    "mocap-gateway calibrate body --link /tmp/suit --rig suit_17 --emulated -o mine.yaml"
)(body)
calibrate_app.command(
    epilog="Examples: mocap-gateway calibrate cameras --import Calib.qca.txt -o cameras.yaml; "
    "mocap-gateway calibrate cameras left=lens/left right=lens/right --scene left=floor_left.png "
    "--scene right=floor_right.png --board checkerboard:7x4:0.06"
)(cameras)
calibrate_app.command("history", epilog="Example: mocap-gateway calibrate history mine.yaml")(versions)
calibrate_app.command("restore", epilog="Example: mocap-gateway calibrate restore mine.yaml")(put_back)
