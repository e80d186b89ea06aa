"""glTF 2.0, binary (.glb): a skinned skeleton with one animation; the container by the library pygltflib.

Every segment is a joint of the skin; its bones move with it wholly. Rotations of all segments and the path
of the root are the animation's channels.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.body.bones import BONE_FACES, BONE_VERTICES, bones_of
from gateway.frames import FloatArray
from gateway.recording.exporters.take import Take, rotation
from gateway.support.extras import require_package

_FLOAT, _UNSIGNED_INT, _UNSIGNED_SHORT = 5126, 5125, 5123
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_SKIN_COLOUR = [0.35, 0.6, 0.85, 1.0]


def write(take: Take, path: Path, units_per_m: float) -> None:
    """Write a take as binary glTF. Raises ``GatewayError`` without the extra ``export``, ``OSError``."""
    require_package("pygltflib")
    import pygltflib  # noqa: PLC0415 - an extra

    document = _Document(pygltflib)
    document.add_skeleton(take, units_per_m)
    document.add_body(take, units_per_m)
    document.add_animation(take, units_per_m)
    document.save(path)


class _Document:
    """A glTF file in the making: one buffer, everything appended to it."""

    def __init__(self, library: Any) -> None:
        self._library = library
        self._gltf = library.GLTF2(asset=library.Asset(version="2.0", generator="mocap-gateway"))
        self._blob = bytearray()

    def add_skeleton(self, take: Take, units_per_m: float) -> None:
        """Add a node for every segment, at rest as in BVH, and the skin that they move."""
        skeleton, library = take.skeleton, self._library
        for s, name in enumerate(skeleton.segment_names):
            children = np.flatnonzero(skeleton.parents == s).tolist()
            offset = np.zeros(3) if skeleton.parents[s] < 0 else skeleton.offsets[s] * units_per_m
            self._gltf.nodes.append(library.Node(name=name, children=children, translation=offset.tolist()))
        inverse_bind = np.tile(np.eye(4, dtype=np.float32), (skeleton.n_segments, 1, 1))
        inverse_bind[:, 3, :3] = -_at_rest(take) * units_per_m  # column-major: the last row is the place
        accessor = self._accessor(inverse_bind.reshape(-1, 16), _FLOAT, "MAT4")
        root = int(np.flatnonzero(skeleton.parents < 0)[0])
        joints = list(range(skeleton.n_segments))
        self._gltf.skins.append(
            library.Skin(name=skeleton.name, joints=joints, skeleton=root, inverseBindMatrices=accessor)
        )

    def add_body(self, take: Take, units_per_m: float) -> None:
        """Add the bones as one skinned mesh, and the scene."""
        library = self._library
        positions, normals, joints = _bone_mesh(take, units_per_m)
        # A bone is rigid: each corner follows one joint, with full weight.
        weights = np.zeros((len(positions), 4), np.float32)
        weights[:, 0] = 1.0
        attributes = library.Attributes(
            POSITION=self._accessor(positions, _FLOAT, "VEC3", _ARRAY_BUFFER, has_bounds=True),
            NORMAL=self._accessor(normals, _FLOAT, "VEC3", _ARRAY_BUFFER),
            JOINTS_0=self._accessor(joints, _UNSIGNED_SHORT, "VEC4", _ARRAY_BUFFER),
            WEIGHTS_0=self._accessor(weights, _FLOAT, "VEC4", _ARRAY_BUFFER),
        )
        indices = np.arange(len(positions), dtype=np.uint32)
        faces = self._accessor(indices, _UNSIGNED_INT, "SCALAR", _ELEMENT_ARRAY_BUFFER)
        material = library.PbrMetallicRoughness(
            baseColorFactor=_SKIN_COLOUR, metallicFactor=0.1, roughnessFactor=0.7
        )
        self._gltf.materials.append(library.Material(pbrMetallicRoughness=material))
        primitive = library.Primitive(attributes=attributes, indices=faces, material=0)
        self._gltf.meshes.append(library.Mesh(name="body", primitives=[primitive]))
        self._gltf.nodes.append(library.Node(name="body", mesh=0, skin=0))
        root = int(np.flatnonzero(take.skeleton.parents < 0)[0])
        self._gltf.scenes.append(library.Scene(nodes=[root, len(self._gltf.nodes) - 1]))
        self._gltf.scene = 0

    def add_animation(self, take: Take, units_per_m: float) -> None:
        """Add the local rotations of all segments, and where the root is."""
        library = self._library
        animation = library.Animation(name=take.name)
        times = self._accessor(take.time_s.astype(np.float32)[:, None], _FLOAT, "SCALAR", has_bounds=True)
        root = int(np.flatnonzero(take.skeleton.parents < 0)[0])
        # glTF turns each node against its parent; only the root has a place of its own.
        tracks = [(s, "rotation", _local_xyzw(take, s), "VEC4") for s in range(take.skeleton.n_segments)]
        tracks.append((root, "translation", take.p_w[:, root] * units_per_m, "VEC3"))
        for node, what, values, kind in tracks:
            output = self._accessor(values.astype(np.float32), _FLOAT, kind)
            animation.samplers.append(library.AnimationSampler(input=times, output=output))
            target = library.AnimationChannelTarget(node=node, path=what)
            channel = library.AnimationChannel(sampler=len(animation.samplers) - 1, target=target)
            animation.channels.append(channel)
        self._gltf.animations.append(animation)

    def save(self, path: Path) -> None:
        """Write the .glb."""
        self._gltf.buffers.append(self._library.Buffer(byteLength=len(self._blob)))
        self._gltf.set_binary_blob(bytes(self._blob))
        self._gltf.save_binary(str(path))

    def _accessor(
        self,
        values: NDArray[Any],
        component: int,
        kind: str,
        target: int | None = None,
        has_bounds: bool = False,
    ) -> int:
        """Append an array (n, width) to the buffer; the index of what describes it."""
        library = self._library
        # glTF requires that every array begins at a multiple of four bytes.
        while len(self._blob) % 4:
            self._blob.append(0)
        data = np.ascontiguousarray(values).tobytes()
        view = library.BufferView(buffer=0, byteOffset=len(self._blob), byteLength=len(data), target=target)
        self._blob += data
        self._gltf.bufferViews.append(view)
        bounds = {}
        # glTF requires the bounds of positions and of times.
        if has_bounds:
            rows = values.reshape(len(values), -1)
            bounds = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._gltf.accessors.append(
            library.Accessor(
                bufferView=len(self._gltf.bufferViews) - 1,
                componentType=component,
                count=len(values),
                type=kind,
                **bounds,
            )
        )
        return len(self._gltf.accessors) - 1


def _at_rest(take: Take) -> FloatArray:
    """Return the proximal joints (S, 3) with all rotations zero, m."""
    skeleton = take.skeleton
    places = np.zeros((skeleton.n_segments, 3))
    for s, parent in enumerate(skeleton.parents):
        if parent >= 0:
            places[s] = places[parent] + skeleton.offsets[s]
    return places


def _bone_mesh(
    take: Take, units_per_m: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint16]]:
    """Return the corners of all faces at rest, their normals, and the joint that moves each."""
    bones, rest = bones_of(take.skeleton), _at_rest(take)
    turns = rotation(bones.q_segment_from_bone)
    corners, joints = [], []
    for b, segment in enumerate(bones.segment):
        shape = turns[b].apply(BONE_VERTICES * bones.scale[b]) + rest[segment]
        # Corners are not shared between faces, so that each face keeps its own normal: flat shading.
        corners.append(shape[BONE_FACES].reshape(-1, 3))
        joints.append(np.full(BONE_FACES.size, segment))
    positions = np.concatenate(corners) * units_per_m
    faces = positions.reshape(-1, 3, 3)
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moved_by = np.zeros((len(positions), 4), np.uint16)
    moved_by[:, 0] = np.concatenate(joints)
    return positions.astype(np.float32), np.repeat(normals, 3, axis=0).astype(np.float32), moved_by


def _local_xyzw(take: Take, segment: int) -> FloatArray:
    """Return rotations (F, 4) in the parent, x y z w; neighbouring frames have the same sign."""
    own, parent = rotation(take.q_wb[:, segment]), take.skeleton.parents[segment]
    local = own if parent < 0 else rotation(take.q_wb[:, parent]).inv() * own
    q: FloatArray = local.as_quat()
    # q and -q are one rotation, but a player interpolates components: a flip of sign would spin the segment.
    flips = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0))
    q[1:] *= flips[:, None]
    return q
