"""Says so where a command has to compile first."""

from __future__ import annotations

import typer

from gateway.reconstruction import readiness


def make_ready(reconstructor: str) -> None:
    """Compile a method that is not yet, and tell why that takes a minute."""
    if not readiness.is_ready(reconstructor):
        typer.echo(
            f"compiling the method '{reconstructor}': once after an installation, about a minute", err=True
        )
        readiness.make_ready(reconstructor)
