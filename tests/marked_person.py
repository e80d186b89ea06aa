"""A person with four markers on every segment, whose subject file lies in a folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gateway.body.body_file import load_body
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.body.subject_file import subject_content, write_subject
from gateway.frames import FloatArray
from gateway.reconstruction.optical import kernels
from gateway.recording.snapshot import body_of


def subject_file(folder: Path, vertical: str) -> tuple[Path, Skeleton, BodyMarkers]:
    """The file ``anna.yaml`` and what is in it; vertical: axis of the optical system that points up."""
    body = load_body("human_17")
    segments = np.repeat(np.arange(body.n_segments), 4)
    places = np.random.default_rng(3).normal(0.0, 0.08, (len(segments), 3))
    labels = tuple(f"m{i}" for i in range(len(segments)))
    markers = BodyMarkers(labels, segments, places, np.full(len(segments), 0.004), vertical)
    path = folder / "anna.yaml"
    write_subject(path, subject_content("anna", "plug_in_gait", body_of(body), body, markers, {}, {}))
    return path, body, markers


def places_of(body: Skeleton, markers: BodyMarkers, R: FloatArray) -> FloatArray:
    """(M, 3) m in the world, for segments turned by ``R`` (S, 3, 3) and a pelvis at breast height."""
    p = kernels.places(body.parents, body.offsets, R, np.array([0.3, -0.2, 0.95]))
    places: FloatArray = kernels.marker_places(markers.segments, markers.positions, R, p)
    return places


def y_up(world: FloatArray) -> FloatArray:
    """(..., 3) the same places in the axes of a system whose y points up."""
    return world[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
