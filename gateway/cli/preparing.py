"""Says so where a command has to compile first."""

from __future__ import annotations

from functools import partial

import typer

from gateway.cli.compiling import told_when_compiling
from gateway.reconstruction import OPTICAL, readiness
from gateway.reconstruction.optical.warm_up import warm_up


def make_ready(reconstructor: str) -> None:
    """Compile a method that is not yet, and tell why that takes its time."""
    if reconstructor == OPTICAL:
        with told_when_compiling(partial(typer.echo, err=True)):
            warm_up()
    elif not readiness.is_ready(reconstructor):
        typer.echo(
            f"compiling the method '{reconstructor}': once after an installation, about a minute", err=True
        )
        readiness.make_ready(reconstructor)
