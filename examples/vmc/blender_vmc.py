"""Move an armature in Blender by the VMC protocol. Text editor → Open → Run script.

Needs nothing but Blender: OSC is read here. Name the armature and its bones below; bones must be at rest in a
T-pose, facing -y (as Blender's own humanoids do). The gateway's configuration: outputs: {vmc: {}}
"""

import socket
import struct

try:
    import bpy
    from mathutils import Quaternion, Vector
except ImportError:  # outside Blender the reading of OSC can still be used
    bpy = None

PORT = 39539
ARMATURE = "Armature"
BONE_NAMES = {"Hips": "hips", "Spine": "spine", "Head": "head"}
"""Unity's to the armature's, where they differ from each other."""
INTERVAL_S = 1 / 60


def messages(datagram):
    """(address, values) of every message of an OSC datagram."""
    if datagram.startswith(b"#bundle\0"):
        at = 16  # behind the time tag
        while at + 4 <= len(datagram):
            (size,) = struct.unpack_from(">i", datagram, at)
            yield from messages(datagram[at + 4 : at + 4 + size])
            at += 4 + size
        return
    address, at = _text(datagram, 0)
    tags, at = _text(datagram, at)
    values = []
    for tag in tags[1:]:
        if tag == "s":
            value, at = _text(datagram, at)
        elif tag in "fi":
            (value,) = struct.unpack_from(">" + tag, datagram, at)
            at += 4
        else:
            return  # nothing that VMC sends
        values.append(value)
    yield address, values


def _text(data, at):
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 4 - end % 4


def blender_vector(x, y, z):
    """Unity (left-handed, y up, facing z) to Blender (right-handed, z up, facing -y)."""
    return (-x, -z, y)


def blender_rotation(x, y, z, w):
    """The same for a rotation; w first, as Blender has it."""
    turned = blender_vector(x, y, z)
    return (w, *(-value for value in turned))


def apply(armature, name, values):
    """Set one bone: rotations are in the axes of the T-pose, a bone's own lie along it."""
    bone = armature.pose.bones.get(BONE_NAMES.get(name, name))
    if bone is None:
        return
    rest = bone.bone.matrix_local.to_quaternion()
    turn = Quaternion(blender_rotation(*values[3:]))
    bone.rotation_mode = "QUATERNION"
    bone.rotation_quaternion = rest.inverted() @ turn @ rest
    if name == "Hips":
        above_rest = Vector(blender_vector(*values[:3])) - bone.bone.head_local
        bone.location = rest.inverted() @ above_rest


def listen(port=PORT):
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", port))
    receiver.setblocking(False)
    return receiver


def step(receiver, armature):
    """Take all that has come; called by Blender's timer."""
    while True:
        try:
            datagram = receiver.recv(65536)
        except BlockingIOError:
            return INTERVAL_S
        for address, values in messages(datagram):
            if address == "/VMC/Ext/Bone/Pos":
                apply(armature, values[0], values[1:])


if bpy is not None and __name__ == "__main__":
    open_receiver = listen()
    bpy.app.timers.register(lambda: step(open_receiver, bpy.data.objects[ARMATURE]))
