"""``mocap-gateway kernels``: what is compiled beforehand."""

from __future__ import annotations

import json
import time
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from gateway.cli.options import AsJson
from gateway.errors import GatewayError, nearest
from gateway.geometry import compiled
from gateway.service import readiness
from gateway.support.processor import target_name

kernels_app = typer.Typer(
    help="Numerical kernels: compile them beforehand, show how far they are.",
    epilog="Examples: mocap-gateway kernels build; mocap-gateway kernels status joint",
    no_args_is_help=True,
    add_completion=False,
)

Methods = Annotated[
    list[str] | None,
    typer.Argument(help=f"Methods; else those of the usual run: {', '.join(readiness.USUAL)}."),
]


@kernels_app.command(epilog="Examples: mocap-gateway kernels build; mocap-gateway kernels build gyro_free")
def build(
    methods: Methods = None,
    for_all: Annotated[
        bool, typer.Option("--for-all", help="Into the installation itself, for all who use it.")
    ] = False,
) -> None:
    """Compile what methods need, from the bytes of a suit to the pose, on all cores. What is there stays.

    `NUMBA_CACHE_DIR` says where it lies, else a folder of the package, or the user's cache.
    """
    names = _known(methods)
    begun_s = time.monotonic()
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed} of {task.total}")
    folder = compiled.SHIPPED if for_all else None
    if folder is None and all(map(readiness.is_ready, names)):
        typer.echo(f"kernels of {', '.join(names)} are ready ({target_name()})")
        return
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True)) as progress:
        task = progress.add_task("compiling kernels, once")

        def report(done: int, of: int) -> None:
            progress.update(task, completed=done, total=of)

        readiness.make_ready(*names, progress=report, folder=folder)
    seconds = time.monotonic() - begun_s
    typer.echo(f"kernels of {', '.join(names)} compiled for {target_name()} in {seconds:.0f} s")


@kernels_app.command(epilog="Example: mocap-gateway kernels status joint")
def status(
    methods: Methods = None,
    as_json: AsJson = False,
) -> None:
    """Show for each method how many of its kernels are ready, what they are compiled for, and where they lie.

    Ends with 1 if one is not ready.
    """
    found = {name: readiness.readiness(name) for name in _known(methods)}
    if as_json:
        states = {name: {"ready": each.ready, "kernels": each.kernels} for name, each in found.items()}
        folder = str(compiled.CACHE_DIRECTORY)
        typer.echo(json.dumps({"target": target_name(), "folder": folder, "methods": states}))
    else:
        for name, each in found.items():
            typer.echo(f"{name}: {readiness.in_words(each)}")
        typer.echo(f"for {target_name()}, in {compiled.CACHE_DIRECTORY}")
    if not all(each.is_complete for each in found.values()):
        raise typer.Exit(1)


def _known(methods: list[str] | None) -> list[str]:
    """Return the methods to work on. Raises ``GatewayError`` for a name that no method has."""
    for name in methods or ():
        if name not in readiness.LONG_COMPILED:
            raise GatewayError(f"no kernels of '{name}'" + nearest(name, sorted(readiness.LONG_COMPILED)))
    return list(dict.fromkeys(methods or readiness.USUAL))
