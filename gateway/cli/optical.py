"""``mocap-gateway optical``: markers of an optical system to a skeleton."""

from __future__ import annotations

import typer

from gateway.cli.optical_fit import fit
from gateway.cli.optical_serve import serve
from gateway.cli.optical_solve import play, solve

optical_app = typer.Typer(
    help="Markers of an optical system (C3D, TRC, live): fit a body, solve, play.", no_args_is_help=True
)
optical_app.command(
    epilog="Examples: mocap-gateway optical fit static.c3d walk1.c3d -o anna.yaml; "
    "mocap-gateway optical fit static.trc walk.trc --set opensim_41 --measure left_knee_width=0.105"
)(fit)
optical_app.command(
    epilog="Examples: mocap-gateway optical solve walk.c3d --subject anna.yaml --to bvh; "
    "mocap-gateway optical solve walk.c3d --subject anna.yaml --plot residuals.png; "
    "mocap-gateway optical solve walk.c3d --subject anna.yaml --method published -o walk_published.mcap"
)(solve)
optical_app.command(
    epilog="Example: mocap-gateway optical play walk.c3d --subject anna.yaml --embedded --speed 0.5"
)(play)
optical_app.command(
    epilog="Example: mocap-gateway optical serve walk.c3d --port 22223, and a link 'url: qtm://127.0.0.1:22223'"
)(serve)
