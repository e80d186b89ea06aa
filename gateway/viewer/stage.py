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
from gateway.geometry import quaternion

FOLLOWING_S = 0.25
"""Time constant in which the view goes to the body, however many pictures are drawn: a walk at 1.5 m/s is
shown 0.4 m off the middle, its sway is not followed."""
FIELD_OF_VIEW_DEG = 45.0
NARROW = 0.8
"""Width by height of a page below which it is held upright, with the panel over its lower half."""
FLOOR_M, SECTION_M = 24.0, 1.0
LOST_M = 2.0
"""A place farther off than this is gone to at once."""
FLOOR_COLOURS = {
    True: ((52, 55, 62), (96, 102, 114)),
    False: ((214, 216, 222), (172, 176, 186)),
}
"""Lines of cells and of sections, in the dark and in the light."""
VIEWS = ("front", "side", "top", "follow")
FIRST_VIEW = "first"
"""Of a page that is opened: the face is seen, and which side is left."""
_FAR_M, _EYES_M, _MIDDLE_M = 3.2, 1.2, 0.88
_NARROW_FARTHER, _NARROW_LOWER_M = 1.65, 1.06
"""On a page that is held upright the whole body stands above the panel."""
_ASIDE_M = 0.4
"""On any other page it stands to the left of the middle, for the panel is on the right."""


class ViewerStage:
    """Made once a page. Cameras stay where their users have put them, on however many pages."""

    def __init__(self, server: viser.ViserServer) -> None:
        _theme(server, is_dark=True)
        _light(server.scene)
        self._ahead = np.array([1.0, 0.0])
        camera = server.initial_camera
        camera.position, camera.look_at = self._seen_from(FIRST_VIEW, is_narrow=False)
        camera.fov = math.radians(FIELD_OF_VIEW_DEG)

        self._looks: dict[int, tuple[str, bool]] = {}
        """By client: the view that it was brought to last, and whether its page was narrow then."""
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._forget)
        self._world = server.scene.add_frame("/world", axes_length=0.25, axes_radius=0.006)
        self._floor = _floor(server.scene)
        self._server = server
        self._is_dark = True
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
        is_at_once = elapsed_s < 0.0 or float(np.hypot(way[0], way[1])) > LOST_M
        self.middle = self.middle + (1.0 if is_at_once else -math.expm1(-elapsed_s / FOLLOWING_S)) * way
        self._followed_s = time_s
        self._world.position = -self.middle
        self._floor.position = -(self.middle % SECTION_M)

    def face(self, q_root: FloatArray) -> None:
        """Remember where the body faces, for ``look``. q_root: (4,) root segment to world, ISB axes."""
        ahead = quaternion.rotate(q_root, np.array([1.0, 0.0, 0.0]))[:2]
        if (length := float(np.linalg.norm(ahead))) > 0.2:
            self._ahead = ahead / length

    def look(self, client: viser.ClientHandle | None, view: str) -> None:
        """Bring one page's camera to a view: front, side (its left one), top, or follow, from behind."""
        for each in [client] if client else list(self._server.get_clients().values()):
            is_narrow = each.camera.aspect < NARROW
            self._looks[each.client_id] = view, is_narrow
            each.camera.position, each.camera.look_at = self._seen_from(view, is_narrow)

    def _welcome(self, client: viser.ClientHandle) -> None:
        self.look(client, FIRST_VIEW)
        client.camera.on_update(lambda _camera: self._fit(client))

    def _forget(self, client: viser.ClientHandle) -> None:
        self._looks.pop(client.client_id, None)

    def _fit(self, client: viser.ClientHandle) -> None:
        """Look anew where the page has become narrow or wide: a slow one reports its size late, a phone is
        turned."""
        view, was_narrow = self._looks.get(client.client_id, (FIRST_VIEW, False))
        if (client.camera.aspect < NARROW) != was_narrow:
            self.look(client, view)

    def _seen_from(self, view: str, is_narrow: bool) -> tuple[FloatArray, FloatArray]:
        """Return where a camera is for a view, (3,) m, and what it looks at, (3,) m."""
        x, y = self._ahead.tolist()
        far = _FAR_M * (_NARROW_FARTHER if is_narrow else 1.0)
        lower = _NARROW_LOWER_M if is_narrow else 0.0
        if view == "top":
            below = np.array([-lower * x, -lower * y, 0.0])
            # Not straight from above, where no direction of the picture would be up.
            return below + np.array([-0.02 * x, -0.02 * y, far + 1.2]), below
        ahead, left = {
            "front": (1.0, 0.0),
            "side": (0.0, 1.0),
            "follow": (-0.8, -0.6),
            FIRST_VIEW: (0.86, 0.51),
        }[view]
        up = _EYES_M + (0.7 if view == "follow" else 0.0)
        toward = np.array([ahead * x - left * y, ahead * y + left * x])
        aside = (0.0 if is_narrow else _ASIDE_M) * np.array([-toward[1], toward[0]])
        return np.array([*(far * toward + aside), up]), np.array([*aside, _MIDDLE_M - lower])

    def show_dark(self, is_dark: bool) -> None:
        """Show all pages in the dark or in the light."""
        if is_dark == self._is_dark:
            return
        self._is_dark = is_dark
        _theme(self._server, is_dark)
        self._floor.cell_color, self._floor.section_color = FLOOR_COLOURS[is_dark]


STYLE = """<style>
:root { --mocap-good: #1b7a3d; --mocap-fair: #8a5a00; --mocap-poor: #c2261b; }
[data-mantine-color-scheme=dark] { --mocap-good: #5ec98a; --mocap-fair: #e3a938; --mocap-poor: #ff8076; }
[data-mantine-color-scheme=light] { --mantine-color-blue-filled: #1864ab !important;
  --mantine-color-blue-outline: #1864ab !important; --mantine-primary-color-filled: #1864ab !important; }
label, p:has(> label) { opacity: 1 !important; color: inherit !important; }
[aria-hidden=true][inert] { display: none !important; }
.mantine-Notification-root[style*="orange"] { display: none !important; }
@media (max-width: 600px) {
  .mantine-Paper-root[style*="max-height: 60%"] { width: 100% !important; max-height: 52% !important; }
  .mantine-ScrollArea-content > div[style="width: 20em;"] { width: 100% !important; }
}
</style>"""
"""Colours that can be read on the panel, in the dark and in the light; labels as dark as other texts. What is
folded away takes no room while the page is loaded; that no graphics processor is there is no warning, for
none is needed; on a phone the panel takes the lower half."""


def _theme(server: viser.ViserServer, is_dark: bool) -> None:
    server.gui.configure_theme(dark_mode=is_dark, show_logo=False, show_share_button=False)


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
        cell_color=FLOOR_COLOURS[True][0],
        section_color=FLOOR_COLOURS[True][1],
        shadow_opacity=0.0,
        fade_distance=FLOOR_M / 2,
        fade_from="origin",
    )
