"""One picture of a body with its muscles, as plain lines: bones grey, muscles pale to red by activity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.analysis.analysing import Analysis
from gateway.analysis.body_model import EXTRA
from gateway.analysis.cycles import Stride
from gateway.analysis.floor import ForceSource
from gateway.analysis.muscles import MuscleResult
from gateway.errors import GatewayError
from gateway.frames import FloatArray

Picture = NDArray[np.uint8]
HEIGHT = 560
WIDTH = 760
_PANE = WIDTH // 2
_BACKGROUND, _FLOOR, _BONE, _TEXT = (255, 255, 255), (170, 170, 170), (120, 110, 105), (60, 50, 40)
_FORCE, _ESTIMATED, _MASS = (60, 150, 60), (105, 180, 105), (200, 110, 30)
_SIDES = {"left": (150, 60, 160), "right": (150, 120, 0)}
"""Blue, green, red of bones of one side."""
_STOPS = np.array([[205, 185, 165], [60, 190, 245], [40, 40, 215]], dtype=np.float64)
"""Colours (blue, green, red) of activity 0, 0.5 and 1."""
_SUBPIXEL = 4
_ARROW_M_PER_WEIGHT = 0.7
_HEAD_M = 0.10


@dataclass(frozen=True)
class Scene:
    """What stays the same from picture to picture."""

    forward: FloatArray  # (3,) unit, level: where the person faces on the whole
    right: FloatArray  # (3,)
    pixels_per_m: float
    floor_m: float
    strides: tuple[Stride, ...] = ()


def require_opencv() -> Any:
    """Return the module ``cv2``. Raises ``GatewayError`` where it is not installed."""
    try:
        import cv2  # noqa: PLC0415 - an extra
    except ImportError:
        raise GatewayError(f"pictures of muscles need opencv (extra 'biomech'): {EXTRA}") from None
    return cv2


def scene_of(found: Analysis) -> Scene:
    """Return views from the right and from the front in which the whole body fits throughout."""
    root = int(np.flatnonzero(found.skeleton.parents < 0)[0])
    facing = found.dynamics.rotation_wb[:, root, :, 0].mean(axis=0) * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(facing))
    forward = facing / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    heights = found.dynamics.p_w[..., 2]
    tall = float(heights.max() - found.floor.height_m.min()) + 0.35
    return Scene(
        forward,
        np.cross(forward, [0.0, 0.0, 1.0]),
        0.88 * HEIGHT / max(tall, 0.5),
        float(found.floor.height_m.min()),
        found.strides,
    )


def draw(found: Analysis, muscles: MuscleResult | None, frame: int, scene: Scene) -> Picture:
    """Return a frame as (HEIGHT, WIDTH, 3) blue, green, red: from the right, and from the front."""
    cv2 = require_opencv()
    picture: Picture = np.full((HEIGHT, WIDTH, 3), _BACKGROUND, dtype=np.uint8)
    for pane, (across, depth) in enumerate(((scene.forward, scene.right), (-scene.right, scene.forward))):
        view = _View(cv2, picture, pane, across, found.dynamics.p_w[frame, 0], scene)
        view.floor()
        _bones(view, found, frame)
        if muscles is not None:
            _wires(view, muscles, frame, depth)
        _forces(view, found, frame)
    _write(picture, f"{found.time_s[frame]:.2f} s", (10, 22), 0.5)
    for k, (side, colour) in enumerate(_SIDES.items()):
        _write(picture, _side_text(side, float(found.time_s[frame]), scene), (90 + 120 * k, 22), 0.45, colour)
    for k, c in enumerate(np.flatnonzero(found.floor.source[frame] == ForceSource.UNKNOWN).tolist()):
        name = found.skeleton.segment_names[int(found.floor.segments[c])].replace("_", " ")
        _write(picture, f"{name} stands on an unknown force", (10, 44 + 18 * k), 0.42)
    if muscles is not None:
        _scale(cv2, picture)
    _legend(picture, found)
    return picture


def _legend(picture: Picture, found: Analysis) -> None:
    """Write what arrows and the dot are, at the bottom."""
    whose = "" if found.is_whole else " of the part that is there"
    words = [(f"dot: centre of mass{whose}", _MASS)]
    for source, colour in ((ForceSource.ESTIMATED, _ESTIMATED), (ForceSource.MEASURED, _FORCE)):
        if (found.floor.source == source).any():
            words.insert(0, (f"floor's force, {source.name.lower()}", colour))
    x = 10
    for text, colour in words:
        _write(picture, text, (x, HEIGHT - 9), 0.4, colour)
        x += 20 + 7 * len(text)


def _side_text(side: str, time_s: float, scene: Scene) -> str:
    """Return a side's name, with where in its stride the foot is, as far as that is known."""
    own = (each for each in scene.strides if each.foot.startswith(side))
    stride = next((each for each in own if each.start_s <= time_s <= each.end_s), None)
    if stride is None:
        return side
    phase = "stance" if time_s < stride.off_s else "swing"
    return f"{side} {stride.percent_at(time_s):.0f} % {phase}"


def png(picture: Picture) -> bytes:
    """Return a picture as PNG."""
    _, data = require_opencv().imencode(".png", picture)
    return bytes(data.tobytes())


class _View:
    """One half of the picture, that follows the person."""

    def __init__(
        self, cv2: Any, picture: Picture, pane: int, across: FloatArray, root: FloatArray, scene: Scene
    ) -> None:
        self._cv2, self._picture, self._across, self._scene = cv2, picture, across, scene
        self._left = pane * _PANE
        self._middle = float(root @ across)

    def floor(self) -> None:
        """Draw the line that the person stands on."""
        y = HEIGHT - 30
        self._cv2.line(self._picture, (self._left + 8, y), (self._left + _PANE - 8, y), _FLOOR, 1)

    def points(self, places: FloatArray) -> NDArray[np.int32]:
        """Return (n, 1, 2) in parts of pixels, of places (n, 3) m."""
        scale = self._scene.pixels_per_m
        x = self._left + 0.5 * _PANE + scale * (places @ self._across - self._middle)
        y = HEIGHT - 30 - scale * (places[:, 2] - self._scene.floor_m)
        fine = np.stack([x, y], axis=1) * 2**_SUBPIXEL
        rounded: NDArray[np.int32] = np.round(fine).astype(np.int32)[:, None]
        return rounded

    def line(self, places: FloatArray, colour: tuple[int, ...], width: int) -> None:
        """Draw a polyline through places (n, 3) m, world. width: pixels."""
        self._cv2.polylines(
            self._picture, [self.points(places)], False, colour, width, self._cv2.LINE_AA, _SUBPIXEL
        )

    def circle(self, place: FloatArray, radius_m: float, colour: tuple[int, ...], width: int) -> None:
        """Draw a circle around a place (3,) m, world. width: pixels; -1: filled."""
        centre = self.points(place[None])[0, 0]
        radius = int(radius_m * self._scene.pixels_per_m * 2**_SUBPIXEL)
        self._cv2.circle(
            self._picture, tuple(map(int, centre)), radius, colour, width, self._cv2.LINE_AA, _SUBPIXEL
        )


def _bones(view: _View, found: Analysis, frame: int) -> None:
    p_w, turned = found.dynamics.p_w[frame], found.dynamics.rotation_wb[frame]
    for s, name in enumerate(found.skeleton.segment_names):
        parent = int(found.skeleton.parents[s])
        tip = p_w[s] + turned[s] @ found.skeleton.tips[s]
        colour = _SIDES.get(name.partition("_")[0], _BONE)
        if parent >= 0:
            view.line(np.stack([p_w[parent], p_w[s]]), colour, 1)
        if name == "head":
            view.circle(0.5 * (p_w[s] + tip), _HEAD_M, _BONE, 2)
        else:
            view.line(np.stack([p_w[s], tip]), colour, 4)


def _wires(view: _View, muscles: MuscleResult, frame: int, depth: FloatArray) -> None:
    """Draw the wires of muscles, farther ones first, so that nearer ones lie over them."""
    paths, activity = muscles.paths[frame], muscles.activity[frame]
    near = [float(np.mean(path @ depth)) for path in paths]
    for i in np.argsort(near):
        view.line(paths[i], colour_of(float(activity[i])), 1 + round(4 * float(np.sqrt(activity[i]))))


def _forces(view: _View, found: Analysis, frame: int) -> None:
    pressure = found.floor.centre_of_pressure()[frame] if len(found.floor.segments) else np.zeros((0, 3))
    for c, at in enumerate(pressure):
        if np.isfinite(at).all():
            arrow = found.floor.force[frame, c] * _ARROW_M_PER_WEIGHT / found.weight_n
            is_measured = found.floor.source[frame, c] == ForceSource.MEASURED
            colour = _FORCE if is_measured else _ESTIMATED
            view.line(np.stack([at, at + arrow]), colour, 2)
            view.circle(at, 0.012, colour, -1)
    view.circle(found.dynamics.centre_of_mass[frame], 0.022, _MASS, -1)


def colour_of(activity: float) -> tuple[int, int, int]:
    """Return blue, green, red of an activity from 0 to 1."""
    mixed = [np.interp(activity, [0.0, 0.5, 1.0], channel) for channel in _STOPS.T]
    blue, green, red = (round(float(value)) for value in mixed)
    return blue, green, red


def _write(
    picture: Picture, text: str, at: tuple[int, int], size: float, colour: tuple[int, ...] = _TEXT
) -> None:
    cv2 = require_opencv()
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _scale(cv2: Any, picture: Picture) -> None:
    """Write what the colours mean, at the top."""
    left, top, width = WIDTH - 190, 12, 110
    for x in range(width):
        cv2.line(picture, (left + x, top), (left + x, top + 8), colour_of(x / (width - 1)), 1)
    for text, x in (("0", left - 12), ("1 activity", left + width + 4)):
        _write(picture, text, (x, top + 9), 0.38)
