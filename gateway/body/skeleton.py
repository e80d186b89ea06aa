"""The body as data: segment names, a parent array with parents first, joint offsets, markers.

No attribute a bone, no left and right copies of code. The skeleton is constant; poses are arrays
indexed by segment.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from devices.calibration import SensorCalibration
from gateway.body.camera import Camera
from gateway.body.joints import WORLD, Joint
from gateway.errors import GatewayError
from gateway.frames import FloatArray, IntArray, Quantity


@dataclass(frozen=True)
class BodyMarkers:
    """Where every marker sits on its segment: the source's *virtual markers*."""

    labels: tuple[str, ...]
    """Names by which the optical system sends them."""
    segments: IntArray
    """(n_markers,) index of the segment that carries the marker."""
    positions: FloatArray
    """(n_markers, 3) from the segment's proximal joint, segment axes, m."""
    sigmas: FloatArray
    """(n_markers,) m: how far it strays from there, by skin and measurement; its weight is 1/σ²."""
    vertical: str = "z"
    """The axis of the optical system that points up: x, y or z."""


@dataclass(frozen=True)
class Interpolation:
    """A segment whose orientation lies between those of two others."""

    segment: int
    first: int
    second: int
    fraction: float
    """Of the way from the first to the second."""


@dataclass(frozen=True)
class Skeleton:
    """Rigid segments joined in a tree."""

    name: str
    segment_names: tuple[str, ...]
    parents: IntArray
    """(n_segments,) index of the parent segment, -1 for the root; parents come first."""
    offsets: FloatArray
    """(n_segments, 3) the segment's proximal joint in its parent's axes, m: ``L`` of the source.
    Zero for the root."""
    tips: FloatArray
    """(n_segments, 3) where the segment ends (its distal joint or tip), in its own axes, m."""
    neutral: FloatArray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    """(4,) ``q_wb`` of every segment in the neutral posture, facing east."""
    joints: tuple[Joint, ...] = ()
    """How neighbours (and others) turn against each other, for joint angles."""
    stature_m: float | None = None
    """Height of the person that the lengths belong to, m; None: not a person."""
    contacts: tuple[tuple[int, FloatArray], ...] = ()
    """Points that carry the body on the ground: segment, and (3,) from its proximal joint, own axes, m."""
    interpolations: tuple[Interpolation, ...] = ()
    """How segments without module follow others; those that have no rule follow their parent."""

    @property
    def n_segments(self) -> int:
        """How many segments the body has."""
        return len(self.segment_names)

    def index(self, segment: str) -> int:
        """Return index of a segment by name. Raises ``ValueError`` for an unknown one."""
        return self.segment_names.index(segment)


@dataclass(frozen=True)
class LocalDevice:
    """A local measuring device (ML) as worn."""

    quantity: Quantity
    segment: int
    """Segment it sits on."""
    position: FloatArray
    """(3,) from the segment's proximal joint, segment axes, m."""
    device: int | None = None
    """Module id it sends under; None for a fixed point, which sends nothing."""
    orientation: FloatArray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    """(4,) device axes to segment axes: for pressure tubes, which measure along their own."""


@dataclass(frozen=True)
class SunCells:
    """Photoelectric cells on the modules, and the place on earth that gives where the sun stands."""

    latitude_deg: float
    longitude_deg: float
    """East."""
    normals: FloatArray
    """(n_modules, 6, 3) of the cells in the order of the wire, sensor axes; modules as in ``module_ids``."""
    beside_magnetometer: bool = False
    """Whether the magnetometers count too; else the sun is in the place of the earth's field."""


@dataclass(frozen=True)
class VideoSetUp:
    """Calibrated cameras that look at the person, and the network that finds keypoints in their pictures."""

    cameras: tuple[Camera, ...]
    network: str
    pairs: tuple[tuple[int, int], ...] = ()
    """Cameras side by side, by their place in the order: where somebody is partly in the picture of either,
    the two are put together."""


@dataclass(frozen=True)
class CameraPosition:
    """Cameras that look at somebody who wears modules: the middle of the hips is a position device."""

    person: WornSuit
    """The same person as the cameras see them, with ``video``."""
    device: int
    """Id of the local device."""
    sigma_m: float
    latency_ns: int
    """From the instant of a picture to the arrival of its heat maps, at the least."""
    turn_rad: float
    """From east to the X axis of the cameras' world, counter-clockwise seen from above."""


@dataclass(frozen=True)
class SensorRanges:
    """Magnitudes at which the axes of a module's sensors are at the end of their range; infinite: not
    stated."""

    specific_force: float = math.inf
    """m/s²"""
    angular_rate: float = math.inf
    """rad/s"""


@dataclass(frozen=True)
class WornSuit:
    """A skeleton with modules strapped to it: all that a reconstructor needs to know beforehand."""

    skeleton: Skeleton
    module_ids: tuple[int, ...]
    """The modules of the rig in the order of the rows of ``ImuFrame``."""
    module_of_segment: IntArray
    """(n_segments,) row of ``ImuFrame`` that observes the segment, -1 for none."""
    sensor_to_segment: FloatArray
    """(n_segments, 4) ``q_bs``: sensor axes to segment axes; identity where there is no module."""
    lever_arms: FloatArray
    """(n_segments, 3) proximal joint to module, segment axes, m: ``U`` of the source."""
    local_devices: tuple[LocalDevice, ...]
    gravity: FloatArray
    """(3,) world, m/s²: (0, 0, -9.81)."""
    magnetic_field: FloatArray
    """(3,) world, µT: ``h`` of the source."""
    calibrations: Mapping[int, SensorCalibration] = field(default_factory=dict)
    """By module id: corrections of its readings, for those that have one here."""
    ranges: Mapping[int, SensorRanges] = field(default_factory=dict)
    """By module id: where its sensors end, for those of which the rig states it."""
    sun: SunCells | None = None
    """None: light readings are not used."""
    markers: BodyMarkers | None = None
    """For an optical system: where its markers sit; then there may be no modules."""
    video: VideoSetUp | None = None
    """For cameras without markers; ``markers`` are then the keypoints of the network."""
    camera_position: CameraPosition | None = None
    """For cameras that look at somebody with modules."""

    @property
    def marker_labels(self) -> tuple[str, ...]:
        """Names of the markers that poses report; none where they are keypoints, which no pose reports."""
        return () if self.markers is None or self.video is not None else self.markers.labels


def field_vector(norm_ut: float, dip_deg: float, declination_deg: float = 0.0) -> FloatArray:
    """Return the local magnetic field (3,) in ENU, µT.

    dip_deg: angle below the horizontal (positive in the northern hemisphere).
    declination_deg: magnetic north, clockwise from geographic north.
    """
    dip, declination = np.radians(dip_deg), np.radians(declination_deg)
    return norm_ut * np.array(
        [np.cos(dip) * np.sin(declination), np.cos(dip) * np.cos(declination), -np.sin(dip)]
    )


def field_dip_deg(field: FloatArray) -> float:
    """Return its angle below the horizontal; field: (3,) ENU."""
    east, north, up = field
    return float(np.degrees(np.arctan2(-up, np.hypot(east, north))))


def remounted(suit: WornSuit, event: Mapping[str, Any]) -> WornSuit:
    """Return the suit with its modules as a ``calibrated`` event says. Raises ``GatewayError``."""
    rotations, places = suit.sensor_to_segment.copy(), suit.lever_arms.copy()
    try:
        for name, mounting in event["modules"].items():
            if name not in suit.skeleton.segment_names:
                raise GatewayError(f"the calibration is of another body: this one has no segment '{name}'")
            segment = suit.skeleton.index(name)
            rotations[segment], places[segment] = mounting["sensor_to_segment"], mounting["position"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise GatewayError(f"the event of a calibration cannot be read: {error!r}") from error
    return replace(suit, sensor_to_segment=rotations, lever_arms=places)


def reduced(skeleton: Skeleton, worn: list[int]) -> Skeleton:
    """Return the body without what lies beyond the worn segments: they, and all between them."""
    chains = [_ancestors(skeleton, segment) for segment in worn]
    shared = set(chains[0]).intersection(*chains[1:])
    root = max(shared)  # parents stand before their children
    keep = sorted({segment for chain in chains for segment in chain if segment >= root})
    position = {segment: i for i, segment in enumerate(keep)}
    offsets = skeleton.offsets[keep].copy()
    offsets[0] = 0.0
    joints = tuple(
        replace(joint, proximal=position.get(joint.proximal, WORLD), distal=position[joint.distal])
        for joint in skeleton.joints
        if joint.distal in position and (joint.proximal in position or joint.proximal == WORLD)
    )
    between = tuple(
        Interpolation(position[each.segment], position[each.first], position[each.second], each.fraction)
        for each in skeleton.interpolations
        if {each.segment, each.first, each.second} <= position.keys()
    )
    return replace(
        skeleton,
        name=skeleton.name if len(keep) == skeleton.n_segments else f"{skeleton.name}_part",
        segment_names=tuple(skeleton.segment_names[segment] for segment in keep),
        parents=np.array([position.get(int(skeleton.parents[s]), -1) for s in keep], dtype=np.int64),
        offsets=offsets,
        tips=skeleton.tips[keep],
        joints=joints,
        contacts=tuple((position[s], point) for s, point in skeleton.contacts if s in position),
        interpolations=between,
    )


def _ancestors(skeleton: Skeleton, segment: int) -> list[int]:
    chain = [segment]
    while (parent := int(skeleton.parents[chain[-1]])) >= 0:
        chain.append(parent)
    return chain
