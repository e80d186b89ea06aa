"""The command line: all commands are listed here, and imported when they are called."""

from __future__ import annotations

import io
import logging
import os
import sys
from typing import Any, ClassVar

import typer

import gateway
from gateway.cli.lazy_commands import LazyCommand, LazyGroup
from gateway.errors import GatewayError
from gateway.support.names import printable
from gateway.support.whole_files import remedy_of


class _Commands(LazyGroup):
    lazy: ClassVar = {
        "demo": LazyCommand(
            "gateway.cli.demo:demo",
            "See it work, without any hardware or broker.",
            "Example: mocap-gateway demo --seconds 20 --rig robot_arm_4",
        ),
        "run": LazyCommand(
            "gateway.cli.run:run",
            "Read the suit, reconstruct, publish. Ends on Ctrl-C or SIGTERM; "
            "SIGHUP reads the configuration anew.",
            "Example: mocap-gateway run -c config/gateway.yaml",
        ),
        "emulate": LazyCommand(
            "gateway.cli.emulate:emulate",
            "Emulate a suit: a moving body, its sensors with their errors, the modules' protocol.",
            "Example: mocap-gateway emulate --rig suit_17 --on pty --link /tmp/suit",
        ),
        "watch": LazyCommand(
            "gateway.cli.watch:watch",
            "Show the poses that a gateway publishes.",
            "Example: mocap-gateway watch --port 1883 --gateway gateway1",
        ),
        "view": LazyCommand(
            "gateway.cli.watch:view",
            "Show the moving body on a page in the browser, live or from a recording.",
            "Examples: mocap-gateway view --port 1883 --page-port 8080; mocap-gateway view walk.mcap",
        ),
        "record": LazyCommand(
            "gateway.cli.run:record",
            "Run the gateway and record everything: raw bytes, what was sent, poses, events.",
            "Example: mocap-gateway record -c my.yaml --name walk",
        ),
        "replay": LazyCommand(
            "gateway.cli.replay:replay",
            "Play a recording: over MQTT like a live suit, or recomputed at once.",
            "Examples: mocap-gateway replay walk.mcap --speed 2 --embedded; "
            "mocap-gateway replay walk.mcap --verify; mocap-gateway replay walk.mcap --with my_rig.yaml",
        ),
        "import": LazyCommand(
            "gateway.cli.import_files:import_files",
            "Make a recording of other makers' files: Xsens, MVNX, BVH, x-IMU3, Movella DOT, OpenSense, CSV.",
            "Examples: mocap-gateway import femur.csv tibia.csv -o knee.mcap; "
            "mocap-gateway import IMUData/ --map myIMUMappings.xml --neutral 0:1 --forward z -o gait.mcap",
        ),
        "report": LazyCommand(
            "gateway.cli.export:report",
            "Write one HTML page: loss and clocks by module, status, orientations, joint angles, events, "
            "settings.",
            "Example: mocap-gateway report walk.mcap -o walk.html",
        ),
        "analyse": LazyCommand(
            "gateway.cli.analyse:analyse_file",
            "Analyse a motion: joint torques, floor forces, muscles, as tables, one HTML page and a film.",
            "Examples: mocap-gateway analyse walk.mcap --mass 70; "
            "mocap-gateway analyse trial.c3d --subject me.yaml --film -o results/",
        ),
        "batch": LazyCommand(
            "gateway.cli.export:batch",
            "Export, report or re-solve every recording of a folder, on all cores or on a Dask cluster.",
            "Examples: mocap-gateway batch recordings/ --to report --to csv -o results/; "
            "mocap-gateway batch recordings/ --to bvh --with my_rig.yaml --dask tcp://head:8786",
        ),
        "compare": LazyCommand(
            "gateway.cli.compare:compare",
            "Compare two sources of one motion, or two results of one session: angles and places by segment.",
            "Examples: mocap-gateway compare suit.mcap optical.mcap --plot agreement.html; "
            "mocap-gateway compare walk.mcap walk_joint.mcap --same-session; "
            "mocap-gateway compare suit1 optical1 --live --port 1883",
        ),
        "export": LazyCommand(
            "gateway.cli.export:export",
            "Write a recording as BVH, C3D, glTF, TRC, CSV, Parquet, for OpenSim, ROS 2 or Foxglove.",
            "Examples: mocap-gateway export walk.mcap --to bvh; "
            "mocap-gateway export walk.mcap --to c3d --to csv -o exports/ --axes y-up --unit mm",
        ),
        "recordings": LazyCommand(
            "gateway.cli.recordings:recordings",
            "List the recordings of a folder: when, how long, how large, modules, loss.",
            "Example: mocap-gateway recordings recordings/",
        ),
        "info": LazyCommand(
            "gateway.cli.recordings:info",
            "Show what is in a recording: settings, suit, software, channels, losses, events.",
            "Example: mocap-gateway info walk.mcap --extract walk_files/",
        ),
        "recover": LazyCommand(
            "gateway.cli.recordings:recover",
            "Make a whole file of all that can be read of one: after a kill, a power cut or a full disk.",
            "Example: mocap-gateway recover walk.mcap --in-place",
        ),
        "doctor": LazyCommand(
            "gateway.cli.doctor:doctor",
            "Examine a set-up: configuration, ports, lines and buses, modules, broker, clocks, disk.",
            "Examples: mocap-gateway doctor -c config/gateway.yaml; "
            "mocap-gateway doctor -c my.yaml --module-rate 200",
        ),
        "health": LazyCommand(
            "gateway.cli.health:health",
            "Ask the running gateway whether it is well: 0 if it is, 1 if not. It needs a `metrics.port`.",
            "Example: mocap-gateway health --port 9464",
        ),
        "modules": LazyCommand(
            "gateway.cli.modules:modules_app",
            "List, identify, assign and configure the modules of a suit; fetch files from its memory card.",
        ),
        "optical": LazyCommand(
            "gateway.cli.optical:optical_app",
            "Markers of an optical system (C3D, TRC, live): fit a body, solve, play.",
        ),
        "video": LazyCommand(
            "gateway.cli.main:video_app", "Synchronised cameras without markers: solve, overlay, serve."
        ),
        "calibrate": LazyCommand(
            "gateway.cli.calibrate:calibrate_app", "Measure what has to be known before a capture."
        ),
        "body": LazyCommand("gateway.cli.body:body_app", "Bodies: segments, joints, lengths."),
        "fleet": LazyCommand(
            "gateway.cli.fleet:fleet_app",
            "Many gateways: brokers to try, an overview of all, an archive of what they sent.",
        ),
        "kernels": LazyCommand(
            "gateway.cli.kernels:kernels_app",
            "Numerical kernels: compile them beforehand, show how far they are.",
        ),
        "config": LazyCommand(
            "gateway.cli.config:config_app",
            "Check a configuration file, show what may stand in one, make a key, describe a suit's CAN bus.",
        ),
    }

    def invoke(self, ctx: Any) -> Any:
        """Run a command. What is wrong with an option is said in our words, not in those of types."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            _put_into_words(error)
            raise


def _put_into_words(error: Exception) -> None:
    """Change the message of an option whose value is wrong, where typer took that from pydantic."""
    if not hasattr(error, "message"):
        return
    from pydantic import ValidationError

    from gateway.support.settings_files import as_shown, message_of

    if isinstance(error.__cause__, ValidationError):
        problem = error.__cause__.errors()[0]
        shown, wanted = as_shown(problem["input"]), message_of(problem)
        message = wanted if wanted.startswith(shown) else f"{shown}: {wanted}"
        error.message = message.replace("does not match the formats '%Y-%m-%d'", "is no date, YYYY-MM-DD")


class _VideoCommands(LazyGroup):
    lazy: ClassVar = {
        "fetch-model": LazyCommand(
            "gateway.cli.video:fetch_model",
            "Fetch the weights of a pose network through your own package client, once, and check them.",
            "Example: mocap-gateway video fetch-model heavy",
        ),
        "solve": LazyCommand(
            "gateway.cli.video_solve:solve",
            "Solve synchronised videos of calibrated cameras, into a recording that replays, exports and "
            "reports like any other.",
            "Examples: mocap-gateway video solve cam*.mp4 --cameras cameras.yaml --to bvh --to trc; "
            "mocap-gateway video solve left=a.mp4 right=b.mp4 --cameras Calib.qca.txt --network heavy",
        ),
        "overlay": LazyCommand(
            "gateway.cli.video:overlay",
            "Draw skeleton and heat maps on the pictures of all cameras, side by side: a film or pictures.",
            "Examples: mocap-gateway video overlay walk.mcap cam*.mp4; "
            "mocap-gateway video overlay walk.mcap cam*.mp4 -o pictures --every 30",
        ),
        "serve-camera": LazyCommand(
            "gateway.cli.video:serve_camera",
            "Serve the heat maps of one camera over TCP to a gateway elsewhere; no picture leaves here.",
            "Example: mocap-gateway video serve-camera v4l:///dev/video0 --name left --port 9765",
        ),
    }


app = typer.Typer(
    name="mocap-gateway",
    cls=_Commands,
    help="Open motion capture from body-worn sensors: wearable suit in, skeleton over MQTT out.",
    epilog="Examples: mocap-gateway demo; mocap-gateway run -c my.yaml; mocap-gateway view",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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
    """Take options before the subcommand."""


video_app = typer.Typer(
    cls=_VideoCommands,
    help="Synchronised cameras without markers: solve, overlay, serve.",
    epilog="Example: mocap-gateway video solve cam*.mp4 --cameras cameras.yaml -o walk.mcap",
    no_args_is_help=True,
    add_completion=False,
)


@video_app.callback()
def _nothing_beforehand() -> None:
    """Synchronised cameras without markers: solve, overlay, serve."""


def main() -> None:
    """Run the command line. What the user can put right is one line on standard error, exit code 1."""
    logging.basicConfig(format="%(asctime)s %(levelname)-7s %(message)s", level=logging.WARNING)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A terminal of ASCII has no degree sign, and none has a letter for a broken file name.
        sys.stdout.reconfigure(errors="replace")
    try:
        app(prog_name="mocap-gateway")
    except Exception as error:
        message = str(error) if isinstance(error, _user_errors()) else _file_trouble(error)
        if message is None:
            raise
        for line in message.splitlines():
            print(f"mocap-gateway: {printable(line)}", file=sys.stderr)  # noqa: T201 - this is the user's terminal
        sys.exit(1)


def _user_errors() -> tuple[type[Exception], ...]:
    """Return errors that the user can put right. Imported when one comes: ``--help`` needs no devices."""
    from devices.commands.device_errors import DeviceError
    from devices.link import LinkError

    return GatewayError, DeviceError, LinkError


def _file_trouble(error: Exception) -> str | None:
    """Return a line about a file that cannot be used, with what to do; None for any other error."""
    remedy = remedy_of(error) if isinstance(error, OSError) else None
    if not isinstance(error, OSError) or remedy is None:
        return None
    place = next((str(name) for name in (error.filename2, error.filename) if name is not None), "a file")
    return f"{place}: {os.strerror(error.errno or 0)}: {remedy}"
