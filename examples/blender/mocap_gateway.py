"""Blender add-on: an armature that moves along with mocap-gateway, and recordings as animations.

Install: Edit, Preferences, Add-ons, Install from Disk, this file. Then, in the 3D view,
tab "Mocap" of the sidebar (N).

Live needs in the gateway's configuration
    outputs: {udp_json: {port: 39600, include: [position], body: true}}
The armature is made from the body that the gateway tells of once a second. Recordings are read by the command
`mocap-gateway export FILE --to bvh`, which the panel names.
"""

import json
import os
import shlex
import socket
import subprocess
import tempfile

import bpy
from mathutils import Quaternion, Vector

bl_info = {
    "name": "mocap-gateway",
    "author": "mocap-gateway",
    "version": (1, 0, 0),
    "blender": (4, 2, 0),
    "location": "3D view, sidebar, Mocap",
    "description": "Live armature over UDP, and import of recordings",
    "category": "Animation",
}

LIVE_EVERY_S = 1 / 60
MOST_DATAGRAMS = 256  # taken at one turn; only the newest pose is shown


class Body:
    """An armature with a bone a segment, made from a message of topic ``body``."""

    def __init__(self, message, context):
        self.neutral = Quaternion(message["neutral"])
        self.parents = {segment["name"]: segment["parent"] for segment in message["segments"]}
        armature = bpy.data.armatures.new(message["name"])
        self.object = bpy.data.objects.new(message["name"], armature)
        context.scene.collection.objects.link(self.object)
        context.view_layer.objects.active = self.object
        bpy.ops.object.mode_set(mode="EDIT")
        heads = {}
        for segment in message["segments"]:
            name, parent = segment["name"], segment["parent"]
            heads[name] = (
                Vector() if parent is None else heads[parent] + self.neutral @ Vector(segment["offset"])
            )
            bone = armature.edit_bones.new(name)
            tip = self.neutral @ Vector(segment["tip"])
            bone.head, bone.tail = (
                heads[name],
                heads[name] + (tip if tip.length > 1e-3 else Vector((0, 0, 0.05))),
            )
            if parent is not None:
                bone.parent = armature.edit_bones[parent]
        bpy.ops.object.mode_set(mode="OBJECT")
        self.rest = {bone.name: bone.matrix_local.to_quaternion() for bone in armature.bones}
        for bone in self.object.pose.bones:
            bone.rotation_mode = "QUATERNION"

    def show(self, pose, frame=None):
        """Pose the armature; frame: also as a key there. A segment that is not known stays as it was."""
        turns = {}
        for name, parent in self.parents.items():
            orientation = pose["segments"].get(name)
            turned = Quaternion(orientation) @ self.neutral.conjugated() if orientation else None
            turns[name] = turned
            above = Quaternion() if parent is None else turns[parent]
            if turned is None or above is None:
                continue
            bone, rest = self.object.pose.bones[name], self.rest[name]
            bone.rotation_quaternion = rest.conjugated() @ above.conjugated() @ turned @ rest
            place = (pose.get("position") or {}).get(name)
            if parent is None and place:
                bone.location = rest.conjugated() @ Vector(place)
            if frame is not None:
                bone.keyframe_insert("rotation_quaternion", frame=frame)
                if parent is None:
                    bone.keyframe_insert("location", frame=frame)


class Receiver:
    """Datagrams of ``udp_json``; the newest pose is shown."""

    def __init__(self, port):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.body = None
        self.poses = 0

    def poll(self, context, frame=None):
        """Take what has come, and show the newest pose."""
        newest = None
        for _ in range(MOST_DATAGRAMS):
            try:
                message = json.loads(self.socket.recv(65536))
            except BlockingIOError:
                break
            except ValueError:
                continue
            if isinstance(message.get("segments"), list):
                if self.body is None:
                    self.body = Body(message, context)
            elif "segments" in message:
                newest = message
        if newest is not None and self.body is not None:
            self.body.show(newest, frame)
            self.poses += 1

    def close(self):
        self.socket.close()


receiver = None


def take_turn():
    """Blender's timer calls this while live."""
    if receiver is None:
        return None
    try:
        scene = bpy.context.scene
        receiver.poll(bpy.context, scene.frame_current if scene.mocap_keys else None)
    except ReferenceError:  # the armature was deleted: the next body makes another
        receiver.body = None
    return LIVE_EVERY_S


class MOCAP_OT_live(bpy.types.Operator):
    bl_idname = "mocap.live"
    bl_label = "Live"
    bl_description = "Begin, or end, to follow the gateway"

    def execute(self, context):
        global receiver  # noqa: PLW0603
        if receiver is not None:
            receiver.close()
            receiver = None
            return {"FINISHED"}
        try:
            receiver = Receiver(context.scene.mocap_port)
        except OSError as error:
            self.report({"ERROR"}, f"Port {context.scene.mocap_port}: {error}")
            return {"CANCELLED"}
        bpy.app.timers.register(take_turn)
        return {"FINISHED"}


class MOCAP_OT_import(bpy.types.Operator):
    bl_idname = "mocap.import_recording"
    bl_label = "Import recording"
    bl_description = "An armature with the poses of a recording (.mcap) as its animation"
    filepath: bpy.props.StringProperty(subtype="FILE_PATH")
    filter_glob: bpy.props.StringProperty(default="*.mcap", options={"HIDDEN"})

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        command = shlex.split(context.scene.mocap_command)
        with tempfile.TemporaryDirectory() as folder:
            try:
                done = subprocess.run(
                    [*command, "export", self.filepath, "--to", "bvh", "-o", folder],
                    capture_output=True, text=True, check=False,
                )  # fmt: skip
            except OSError as error:
                self.report({"ERROR"}, f"{command[0]}: {error}. Name the command in the panel")
                return {"CANCELLED"}
            files = [name for name in os.listdir(folder) if name.endswith(".bvh")]
            if done.returncode or not files:
                self.report({"ERROR"}, done.stderr.strip() or "nothing was exported")
                return {"CANCELLED"}
            # In centimetres; its bones end where segments do, and the scene gets the recording's frame rate.
            bpy.ops.import_anim.bvh(
                filepath=os.path.join(folder, files[0]), global_scale=0.01, axis_forward="-Z", axis_up="Y",
                rotate_mode="QUATERNION", update_scene_fps=True, update_scene_duration=True,
            )  # fmt: skip
        return {"FINISHED"}


class MOCAP_PT_panel(bpy.types.Panel):
    bl_label = "mocap-gateway"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Mocap"

    def draw(self, context):
        layout, scene = self.layout, context.scene
        layout.prop(scene, "mocap_port")
        layout.prop(scene, "mocap_keys")
        layout.operator("mocap.live", text="End" if receiver else "Live", depress=receiver is not None)
        layout.separator()
        layout.prop(scene, "mocap_command")
        layout.operator("mocap.import_recording")


CLASSES = (MOCAP_OT_live, MOCAP_OT_import, MOCAP_PT_panel)


def register():
    for each in CLASSES:
        bpy.utils.register_class(each)
    properties = bpy.props
    bpy.types.Scene.mocap_port = properties.IntProperty(name="UDP port", default=39600, min=1, max=65535)
    bpy.types.Scene.mocap_keys = properties.BoolProperty(
        name="Set keys", description="Keep the motion as keys"
    )
    bpy.types.Scene.mocap_command = properties.StringProperty(name="Command", default="mocap-gateway")


def unregister():
    global receiver  # noqa: PLW0603
    if receiver is not None:
        receiver.close()
        receiver = None
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
    for name in ("mocap_port", "mocap_keys", "mocap_command"):
        delattr(bpy.types.Scene, name)


if __name__ == "__main__":
    register()
