"""``mocap-gateway video``: cameras without markers to a skeleton."""

from __future__ import annotations

import typer

from gateway.cli.video_fetch import fetch_model
from gateway.cli.video_overlay import overlay
from gateway.cli.video_solve import solve

video_app = typer.Typer(
    help="Synchronised cameras without markers: solve, overlay, serve.", no_args_is_help=True
)
video_app.command(
    epilog="Examples: mocap-gateway video solve cam*.mp4 --cameras cameras.yaml --to bvh --to trc; "
    "mocap-gateway video solve left=a.mp4 right=b.mp4 --cameras Calib.qca.txt --network heavy"
)(solve)
video_app.command("fetch-model", epilog="Example: mocap-gateway video fetch-model heavy")(fetch_model)
video_app.command(
    epilog="Examples: mocap-gateway video overlay walk.mcap cam*.mp4; "
    "mocap-gateway video overlay walk.mcap cam*.mp4 -o pictures --every 30"
)(overlay)
