"""A fitted subject as a file: the body of one person and where markers sit on it. It stands in a rig's
place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import Field

from gateway.body.body_file import BodyFile, Point, WorldSettings, skeleton_of, worn_without_modules
from gateway.body.camera import CameraEntry
from gateway.body.skeleton import BodyMarkers, Skeleton, VideoSetUp, WornSuit
from gateway.errors import SettingsError, nearest
from gateway.support.settings_files import Strict, load_settings
from gateway.support.whole_files import write_whole

_DIGITS = 9


class MarkerEntry(Strict):
    """One marker."""

    label: str = Field(min_length=1, description="name by which the optical system sends it")
    segment: str
    position: Point = Field(description="from the segment's proximal joint, segment axes, m")
    sigma_mm: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] = 5.0


class VideoEntry(Strict):
    """Cameras that look at the subject; the markers are then keypoints of a pose network."""

    network: str = Field(description="whose heat maps come: full, lite, heavy or openpose")
    cameras: list[CameraEntry] = Field(min_length=1, description="in a world whose Z points up")
    joined: list[tuple[str, str]] = Field(
        default=[], description="names of two cameras each, side by side, whose pictures are put together"
    )

    def pairs(self, source: str) -> tuple[tuple[int, int], ...]:
        """Return those side by side by their place in the order. Raises ``SettingsError``."""
        names = [camera.name for camera in self.cameras]
        named = [name for pair in self.joined for name in pair]
        for name in named:
            if name not in names or named.count(name) > 1:
                raise SettingsError(f"{source}: video.joined: '{name}' is no camera, or stands there twice")
        return tuple((names.index(first), names.index(second)) for first, second in self.joined)


class SubjectFile(Strict):
    """What `optical fit` and `video solve --fit-subject` write."""

    subject: str
    marker_set: str = Field(description="name of the marker set it was fitted with")
    vertical: Literal["x", "y", "z", "-x", "-y", "-z"] = Field(
        default="z", description="axis of the optical system that points up; -z: z points down"
    )
    measurements_m: dict[str, float] = Field(default={})
    angles_deg: dict[str, float] = Field(default={}, description="by which wands lie ahead of joints' axes")
    fit: dict[str, Any] = Field(default={}, description="how the fit came about; for the reader")
    markers: list[MarkerEntry] = Field(min_length=3)
    video: VideoEntry | None = None
    body: BodyFile
    world: WorldSettings = WorldSettings()


def is_subject(content: object) -> bool:
    """Return whether the content of a YAML file is a subject, and not a rig."""
    return isinstance(content, dict) and "subject" in content and "markers" in content


def load_subject(path: Path) -> WornSuit:
    """Return a suit of markers and no modules. Raises ``SettingsError`` naming the file, the entry and the
    remedy."""
    file = load_settings(path, SubjectFile)
    skeleton = skeleton_of(file.body, path)
    labels = [entry.label for entry in file.markers]
    for entry in file.markers:
        if entry.segment not in skeleton.segment_names:
            raise SettingsError(
                f"{path}: marker '{entry.label}' sits on '{entry.segment}', which the body does not have"
                + nearest(entry.segment, skeleton.segment_names)
            )
        if labels.count(entry.label) > 1:
            raise SettingsError(f"{path}: marker '{entry.label}' stands twice")

    markers = BodyMarkers(
        labels=tuple(labels),
        segments=np.array([skeleton.index(entry.segment) for entry in file.markers], dtype=np.int64),
        positions=np.array([entry.position for entry in file.markers], dtype=np.float64),
        sigmas=np.array([entry.sigma_mm * 1e-3 for entry in file.markers]),
        vertical=file.vertical,
    )
    suit = worn_without_modules(skeleton, markers, file.world)
    if file.video is None:
        return suit
    cameras = tuple(entry.camera(str(path)) for entry in file.video.cameras)
    return replace(suit, video=VideoSetUp(cameras, file.video.network, file.video.pairs(str(path))))


def subject_content(
    name: str, marker_set: str, body: dict[str, Any], skeleton: Skeleton, markers: BodyMarkers,
    fit: dict[str, Any], lengths: Mapping[str, float], angles: Mapping[str, float] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the content of a subject file. body: the skeleton as the content of a body file; angles: rad."""
    turned = {key: round(math.degrees(value), 4) for key, value in (angles or {}).items() if value}
    return {
        "subject": name,
        "marker_set": marker_set,
        "vertical": markers.vertical,
        "measurements_m": {key: round(value, 6) for key, value in lengths.items()},
        **({"angles_deg": turned} if turned else {}),
        "fit": fit,
        "markers": [
            {
                "label": label,
                "segment": skeleton.segment_names[segment],
                "position": np.round(position, _DIGITS).tolist(),
                "sigma_mm": round(1e3 * float(sigma), 3),
            }
            for label, segment, position, sigma in zip(
                markers.labels, markers.segments.tolist(), markers.positions, markers.sigmas, strict=True
            )
        ],
        "body": body,
    }


def write_subject(path: Path, content: dict[str, Any]) -> None:
    """Write a subject file, whole or not at all. Raises ``OSError``."""
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
    write_whole(path, text.encode())
