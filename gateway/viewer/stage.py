"""What a body stands on: light, a floor, the first look, and a world that is shifted to keep it in view.

What a picture costs a browser without a graphics processor is measured (``benchmarks/viewer.py``): shadows
and an environment map took nearly all of it, so there are neither. Two lights and flat faces give a body
its shape.
"""

from __future__ import annotations

import math

import numpy as np
import viser

from gateway.frames import FloatArray

FOLLOWING_S = 0.25
"""Time constant in which the view goes to the body, however many pictures are drawn: a walk at 1.5 m/s is
shown 0.4 m off the middle, its sway is not followed."""
FIRST_CAMERA: tuple[float, float, float] = (2.1, -2.3, 1.5)
FIRST_LOOK_AT: tuple[float, float, float] = (0.0, 0.0, 0.85)
FIELD_OF_VIEW_DEG = 45.0
NARROW = 0.8
"""Width by height of a page below which it is held upright, with the panel over its lower half."""
NARROW_CAMERA: tuple[float, float, float] = (3.2, -3.5, 1.0)
NARROW_LOOK_AT: tuple[float, float, float] = (0.0, 0.0, -0.12)
FLOOR_M, SECTION_M = 24.0, 1.0


class Stage:
    """Made once a page. Cameras stay where their users have put them, on however many pages."""

    def __init__(self, server: viser.ViserServer) -> None:
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        _light(server.scene)
        camera = server.initial_camera
        camera.position, camera.look_at = FIRST_CAMERA, FIRST_LOOK_AT
        camera.fov = math.radians(FIELD_OF_VIEW_DEG)
        server.on_client_connect(_look_narrow)
        self._world = server.scene.add_frame("/world", axes_length=0.25, axes_radius=0.006)
        self._floor = _floor(server.scene)
        self.middle: FloatArray = np.zeros(3)
        """(3,) m: the place of the world that is shown in the middle; to be taken off whatever is drawn.

        Nodes that hung below one that moves would lag behind it where few pictures are drawn.
        """
        self._followed_s: float | None = None

    def follow(self, place: FloatArray, time_s: float) -> None:
        """Bring a place (3,), m, to where cameras look: at once the first time, then smoothly.

        time_s: on any clock that runs evenly, of this picture; one that runs backward counts as a first time.
        The floor is shifted by parts of a section only, so it never ends.
        """
        elapsed_s = math.inf if self._followed_s is None else time_s - self._followed_s
        way = np.array([place[0], place[1], 0.0]) - self.middle
        self.middle = self.middle + (1.0 if elapsed_s < 0.0 else -math.expm1(-elapsed_s / FOLLOWING_S)) * way
        self._followed_s = time_s
        self._world.position = -self.middle
        self._floor.position = -(self.middle % SECTION_M)


def _look_narrow(client: viser.ClientHandle) -> None:
    """On a phone the body stands in the upper half, above the panel."""
    if client.camera.aspect < NARROW:
        client.camera.position, client.camera.look_at = NARROW_CAMERA, NARROW_LOOK_AT


def _light(scene: viser.SceneApi) -> None:
    scene.set_up_direction("+z")
    scene.configure_environment_map(None)
    scene.configure_default_lights(enabled=False)
    scene.add_light_hemisphere(
        "/light/sky", sky_color=(255, 255, 255), ground_color=(95, 100, 110), intensity=1.3
    )
    scene.add_light_directional("/light/sun", intensity=1.7, position=(3.0, -4.0, 6.0))


def _floor(scene: viser.SceneApi) -> viser.GridHandle:
    return scene.add_grid(
        "/floor",
        width=FLOOR_M,
        height=FLOOR_M,
        cell_size=SECTION_M / 4,
        section_size=SECTION_M,
        cell_color=(52, 55, 62),
        section_color=(96, 102, 114),
        shadow_opacity=0.0,
        fade_distance=FLOOR_M / 2,
        fade_from="origin",
    )
