"""``mocap-gateway video overlay``: skeleton and heat maps on the pictures."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated

import typer

from devices.cameras.pictures import open_pictures
from gateway.cameras.film import drawn_instants, write_film
from gateway.cli.progress import progress_bar
from gateway.cli.video_sources import Offset, Rate, named, offsets_of
from gateway.errors import GatewayError
from gateway.recording.reading import open_recording
from gateway.support.video_extra import require_video_extra


def overlay(
    recording: Annotated[Path, typer.Argument(help="Recording of `video solve`.")],
    files: Annotated[list[str], typer.Argument(metavar="FILES…", help="The videos it was made of.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="An .mp4, or a folder for single pictures; default: .mp4."),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Take every so many pictures.")] = 1,
    height: Annotated[int, typer.Option(min=64, help="Of the row of pictures, pixels.")] = 720,
    heat_maps: Annotated[bool, typer.Option(help="Draw the heat maps too.")] = True,
    offset: Offset = None,
    rate: Rate = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
) -> None:
    """Draw skeleton and heat maps on the pictures of all cameras, side by side: a film or pictures."""
    require_video_extra()
    opened = open_recording(recording)
    video = opened.meta.suit.video
    if video is None:
        raise GatewayError(f"{recording} was not made of cameras: `mocap-gateway video solve` makes one")
    target = output or recording.with_name(f"{recording.stem}_overlay.mp4")
    if target.is_file() and not force:
        raise GatewayError(f"{target} exists: name another file with --output, or replace it with --force")
    known = [camera.name for camera in video.cameras]
    places = named(files, known, recording)
    absent = [name for name in known if name not in places]
    if absent:
        raise GatewayError(f"{recording} has a camera '{absent[0]}': give its file too")
    skipped = offsets_of(offset or [], known)
    sources = [open_pictures(places[name], rate) for name in known]
    pictures = [
        itertools.islice(source, skipped.get(name, 0), None)
        for name, source in zip(known, sources, strict=True)
    ]
    rows = (tuple(picture for _, picture in row) for row in zip(*pictures, strict=False))
    drawn = drawn_instants(opened, video, rows, height=height, every=every, has_maps=heat_maps)
    total = min(source.info.count or 0 for source in sources) // every
    with progress_bar("drawing") as tell:
        written = write_film(drawn, target, sources[0].info.rate_hz / every, lambda done: tell(done, total))
    typer.echo(f"{target}: {written} pictures")
