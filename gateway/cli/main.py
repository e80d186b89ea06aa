"""The command line: one file a subcommand, listed here."""

from __future__ import annotations

import logging
import sys

import typer

import gateway
from devices.device_errors import DeviceError
from devices.link import LinkError
from gateway.cli.body import body_app
from gateway.cli.calibrate_body import body as calibrate_body
from gateway.cli.calibrate_body import put_back, versions
from gateway.cli.calibrate_clocks import calibrate_app
from gateway.cli.calibrate_sensors import sensors as calibrate_sensors
from gateway.cli.configuration import config_app
from gateway.cli.demo import demo
from gateway.cli.diff import diff
from gateway.cli.doctor import doctor
from gateway.cli.emulate import emulate
from gateway.cli.modules import modules_app
from gateway.cli.record import record
from gateway.cli.recordings import info, recordings, recover
from gateway.cli.replay import replay
from gateway.cli.run import run
from gateway.cli.view import view
from gateway.cli.watch import watch
from gateway.errors import GatewayError

app = typer.Typer(
    name="mocap-gateway",
    help="Open motion capture from body-worn sensors: wearable suit in, skeleton over MQTT out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command(epilog="Example: mocap-gateway demo --seconds 20 --rig robot_arm_4")(demo)
app.command(epilog="Example: mocap-gateway run -c config/gateway.yaml")(run)
app.command(epilog="Example: mocap-gateway emulate --rig suit_17 --on pty --link /tmp/suit")(emulate)
app.command(epilog="Example: mocap-gateway watch --port 1883 --gateway gateway1")(watch)
app.command(epilog="Example: mocap-gateway view --port 1883 --page-port 8080")(view)
app.command(epilog="Example: mocap-gateway record -c my.yaml --name walk")(record)
app.command(
    epilog="Examples: mocap-gateway replay walk.mcap --speed 2 --embedded; "
    "mocap-gateway replay walk.mcap --verify; mocap-gateway replay walk.mcap --with my_rig.yaml"
)(replay)
app.command(epilog="Example: mocap-gateway diff walk.mcap walk_joint.mcap --plot diff.html")(diff)
app.command(epilog="Example: mocap-gateway recordings recordings/")(recordings)
app.command(epilog="Example: mocap-gateway info walk.mcap --extract walk_files/")(info)
app.command(epilog="Example: mocap-gateway recover walk.mcap --in-place")(recover)
app.command(epilog="Example: mocap-gateway doctor -c config/gateway.yaml")(doctor)
app.add_typer(modules_app, name="modules")
calibrate_app.command(
    "sensors",
    epilog="Example: mocap-gateway calibrate sensors --link /dev/ttyUSB0 --rig suit_17 -o mine.yaml",
)(calibrate_sensors)
calibrate_app.command(
    "body",
    epilog="Examples: mocap-gateway calibrate body -c my.yaml; "
    "mocap-gateway calibrate body --link /tmp/suit --rig suit_17 --emulated -o mine.yaml",
)(calibrate_body)
calibrate_app.command("history", epilog="Example: mocap-gateway calibrate history mine.yaml")(versions)
calibrate_app.command("restore", epilog="Example: mocap-gateway calibrate restore mine.yaml")(put_back)
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(body_app, name="body")
app.add_typer(config_app, name="config")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mocap-gateway {gateway.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
    ),
) -> None:
    """Options before the subcommand."""


def main() -> None:
    """Run the command line. What the user can put right is one line on standard error, exit code 1."""
    logging.basicConfig(format="%(asctime)s %(levelname)-7s %(message)s", level=logging.WARNING)
    try:
        app()
    except (GatewayError, DeviceError, LinkError) as error:
        for line in str(error).splitlines():
            print(f"mocap-gateway: {line}", file=sys.stderr)  # noqa: T201 - this is the user's terminal
        sys.exit(1)
