"""Poses do not depend on where time begins: a first frame may come before instant 0."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.emulation.fast_arm import Switches, carried_arm, carried_motion, sampled
from gateway.reconstruction import create_reconstructor
from gateway.reconstruction.reconstructor import update_many


@pytest.mark.parametrize("method", ["joint", "outward", "gyro_free"])
@pytest.mark.parametrize("first_ns", [-1, 0, -250_000_000])
def test_poses_do_not_depend_on_where_time_begins(method, first_ns):
    suit = carried_arm()
    frames = sampled(suit, carried_motion(suit, 1), Switches(), 1, seconds=0.6)

    def begun_at(time_ns: int) -> np.ndarray:
        moved = [
            replace(
                frame,
                time_ns=frame.time_ns + time_ns,
                local=tuple(replace(r, time_ns=r.time_ns + time_ns) for r in frame.local),
            )
            for frame in frames
        ]
        poses = update_many(create_reconstructor(method, suit, 0.01), moved)
        return np.stack([pose.q_wb for pose in poses])

    np.testing.assert_allclose(begun_at(first_ns), begun_at(5_000_000_000), atol=1e-9)
