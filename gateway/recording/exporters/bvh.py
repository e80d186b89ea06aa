"""BVH: hierarchy with rest offsets, then a line of channels a frame. Text; opens in Blender and others.

At rest (all rotations zero) every segment's axes are those of the world: the person stands upright and looks
along x. Offsets are the skeleton's own, so joint rotations are exactly parent to child.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray
from gateway.recording.exporters.take import Take, rotation

ORDER: Final = "ZXY"
"""Of the rotation channels: intrinsic, as BVH multiplies them."""
_DECIMALS = 6


def write(take: Take, path: Path, units_per_m: float) -> None:
    """Write a take as BVH. Raises ``OSError``."""
    skeleton = take.skeleton
    root = int(np.flatnonzero(skeleton.parents < 0)[0])
    order: list[int] = []
    lines = ["HIERARCHY", *_joint_lines(skeleton, root, "", units_per_m, order)]
    lines += ["MOTION", f"Frames: {len(take.q_wb)}", f"Frame Time: {1.0 / take.rate_hz:.9f}"]
    channels = [take.p_w[:, root] * units_per_m]
    channels += [_euler_deg(take, segment) for segment in order]
    with path.open("w", encoding="utf-8") as file:
        file.write("\n".join(lines) + "\n")
        np.savetxt(file, np.hstack(channels), fmt=f"%.{_DECIMALS}f")


def _joint_lines(
    skeleton: Skeleton, segment: int, indent: str, units_per_m: float, order: list[int]
) -> list[str]:
    """Return the lines of a segment and all it carries; append segments to ``order`` by channel."""
    order.append(segment)
    is_root = skeleton.parents[segment] < 0
    offset = np.zeros(3) if is_root else skeleton.offsets[segment] * units_per_m
    places = "Xposition Yposition Zposition " if is_root else ""
    turns = " ".join(f"{axis}rotation" for axis in ORDER)
    inner = indent + "\t"
    lines = [
        f"{indent}{'ROOT' if is_root else 'JOINT'} {skeleton.segment_names[segment]}",
        f"{indent}{{",
        f"{inner}OFFSET {_numbers(offset)}",
        f"{inner}CHANNELS {6 if is_root else 3} {places}{turns}",
    ]
    children = np.flatnonzero(skeleton.parents == segment)
    for child in children:
        lines += _joint_lines(skeleton, int(child), inner, units_per_m, order)
    # The last joint of a limb needs an end site, or programs draw the segment without a length.
    if not len(children):
        end = _numbers(skeleton.tips[segment] * units_per_m)
        lines += [f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET {end}", f"{inner}}}"]
    return [*lines, f"{indent}}}"]


def _euler_deg(take: Take, segment: int) -> FloatArray:
    """Return the rotation of a segment in its parent (F, 3), Euler angles, degrees, unwrapped."""
    own, parent = rotation(take.q_wb[:, segment]), take.skeleton.parents[segment]
    local = own if parent < 0 else rotation(take.q_wb[:, parent]).inv() * own
    angles: FloatArray = np.degrees(np.unwrap(local.as_euler(ORDER), axis=0))
    return angles


def _numbers(vector: FloatArray) -> str:
    return " ".join(f"{value:.{_DECIMALS}f}" for value in vector)
