"""``mocap-gateway modules``: everything about the modules of a suit, one command a line."""

from __future__ import annotations

import typer

from gateway.cli.modules_assign import assign
from gateway.cli.modules_card import card_app
from gateway.cli.modules_list import identify, list_modules, watch_modules
from gateway.cli.modules_settings import backup, restore, set_settings, show, undo

modules_app = typer.Typer(
    help="List, identify, assign and configure the modules of a suit; fetch files from its memory card.",
    no_args_is_help=True,
)

_EXAMPLE = "Example: mocap-gateway modules"
modules_app.command(
    "list",
    epilog=f"{_EXAMPLE} list -c my.yaml; or through a running gateway: modules list --mqtt 127.0.0.1:1883",
)(list_modules)
modules_app.command("watch", epilog=f"{_EXAMPLE} watch --link /dev/ttyUSB0 --rig suit_17")(watch_modules)
modules_app.command("identify", epilog=f"{_EXAMPLE} identify 3 --seconds 10 -c my.yaml")(identify)
modules_app.command(
    "assign",
    epilog=f"{_EXAMPLE} assign -c my.yaml --allow-writes; one segment, without shaking: "
    "modules assign --segment left_shank --device 3f2a --yes -c my.yaml --allow-writes",
)(assign)
modules_app.command("show", epilog=f"{_EXAMPLE} show 3 -c my.yaml")(show)
modules_app.command(
    "set", epilog=f"{_EXAMPLE} set 3 sampling_rate=200 label=left_shank -c my.yaml --allow-writes"
)(set_settings)
modules_app.command("undo", epilog=f"{_EXAMPLE} undo -c my.yaml --allow-writes")(undo)
modules_app.command("backup", epilog=f"{_EXAMPLE} backup suit.yaml -c my.yaml")(backup)
modules_app.command("restore", epilog=f"{_EXAMPLE} restore suit.yaml -c my.yaml --allow-writes")(restore)
modules_app.add_typer(card_app, name="card")
