"""Four cameras around a walker, off its middle."""

import numpy as np

from gateway.body.camera import Camera

MATRIX = np.array([[900.0, 0.0, 639.5], [0.0, 900.0, 359.5], [0.0, 0.0, 1.0]])


def camera(name, angle):
    position = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.5])
    z = np.array([0.0, 0.0, 1.0]) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Camera(name, 1280, 720, MATRIX, np.zeros(5), R, -R @ position)


CAMERAS = [camera(name, angle) for name, angle in (("a", 0.2), ("b", 1.9), ("c", 3.4), ("d", 5.0))]
