"""Run by an interpreter that has Blender: python blender_child.py ADDON DATAGRAMS RECORDING COMMAND ANSWER"""

import importlib.util
import json
import socket
import sys
import time
from pathlib import Path

import bpy

RECORDED_FRAME = 11  # from 1


def world(armature):
    """Rotation (3, 3) and head of each bone, as posed, and at rest."""
    bpy.context.view_layer.update()
    return {
        bone.name: {
            "posed": [list(row) for row in bone.matrix.to_3x3()],
            "rest": [list(row) for row in bone.bone.matrix_local.to_3x3()],
            "head": list(bone.head),
            "tail": list(bone.tail),
        }
        for bone in armature.pose.bones
    }


def live(addon, datagrams):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        bpy.context.scene.mocap_port = free.getsockname()[1]
    bpy.context.scene.mocap_keys = True
    assert bpy.ops.mocap.live() == {"FINISHED"}
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    found = []
    for k, datagram in enumerate(datagrams):
        bpy.context.scene.frame_set(k + 1)
        sender.sendto(datagram.encode(), ("127.0.0.1", bpy.context.scene.mocap_port))
        seen, until = addon.receiver.poses, time.monotonic() + 5
        while k and addon.receiver.poses == seen and time.monotonic() < until:
            assert addon.take_turn() == addon.LIVE_EVERY_S
        if not k:
            time.sleep(0.2)
            addon.take_turn()
        else:
            found.append(world(addon.receiver.body.object))
    armature = addon.receiver.body.object
    bpy.context.scene.frame_set(2)
    keyed = world(armature)
    assert bpy.ops.mocap.live() == {"FINISHED"}
    assert addon.take_turn() is None
    return found, keyed


def recording(path, command):
    bpy.context.scene.mocap_command = command
    before = set(bpy.data.objects)
    assert bpy.ops.mocap.import_recording(filepath=path) == {"FINISHED"}
    (armature,) = [each for each in set(bpy.data.objects) - before if each.type == "ARMATURE"]
    first, last = armature.animation_data.action.frame_range
    bpy.context.scene.frame_set(RECORDED_FRAME)
    bpy.context.view_layer.update()
    place = armature.matrix_world
    bones = {
        bone.name: {"head": list(place @ bone.head), "tail": list(place @ bone.tail)}
        for bone in armature.pose.bones
    }
    return {"bones": bones, "frames": last - first + 1, "fps": bpy.context.scene.render.fps}


def main():
    addon_path, datagrams, recorded, command, answer = sys.argv[1:]
    spec = importlib.util.spec_from_file_location("mocap_gateway_addon", addon_path)
    addon = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(addon)
    addon.register()
    found, keyed = live(addon, json.loads(Path(datagrams).read_text()))
    told = {"live": found, "keyed": keyed, "recording": recording(recorded, command)}
    addon.unregister()
    Path(answer).write_text(json.dumps(told))


main()
