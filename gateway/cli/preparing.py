"""Says so where a command has to compile first, and has something else run until that is done."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import typer

from gateway.cli.compiling import told_when_compiling
from gateway.reconstruction import OPTICAL, RootMode
from gateway.reconstruction.optical.warm_up import warm_up
from gateway.service import readiness
from gateway.settings import GatewaySettings, RootMotionSettings

_FIRST = "first start: compiling what the first poses need, once; 10 to 20 seconds on a machine that is free"


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


def stand_in(settings: GatewaySettings, tell: Callable[[str], object]) -> GatewaySettings:
    """Return the settings that run while the method of these is compiled; what they need is compiled here."""
    with told_when_compiling(tell, _FIRST):
        readiness.make_first_ready()
    in_its_place = RootMotionSettings(mode=RootMode.FIXED)
    return settings.solved_by(readiness.FALLBACK).model_copy(update={"root_motion": in_its_place})
