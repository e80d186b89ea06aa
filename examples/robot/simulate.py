"""A robot in MuJoCo that follows a person: what outputs.retarget.udp sends are the targets of its motors.

    python simulate.py model.urdf --film robot.gif     (pip install mujoco pillow)

It hangs by its base, as from a gantry, turned as the gateway says; limbs have mass, motors are springs with
damping, as strong as the URDF says. When nothing has come for five seconds it says how far joints were off.
"""

import argparse
import contextlib
import json
import socket
from pathlib import Path

import mujoco
import numpy as np

PICTURE_S, SIZE = 0.05, (480, 360)  # of a film; height and width
STIFF, DAMPED = 600, 15  # N m/rad, N m s/rad


def model_of(urdf):
    """The URDF with a motor a joint, its base welded to the body 'gantry', which is moved from outside."""
    spec = mujoco.MjSpec.from_file(str(urdf))
    meshes = {path.name: path for folder in urdf.parents[:3] for path in folder.glob("**/*.stl")}
    for mesh in spec.meshes:
        mesh.file = str(meshes[Path(mesh.file).name])
    spec.compiler.fusestatic = spec.compiler.discardvisual = False  # keeps base link and shapes
    spec.option.timestep, spec.option.integrator = 0.002, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.visual.global_.offheight, spec.visual.global_.offwidth = SIZE
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0  # meshes of neighbours overlap
    base = spec.worldbody.first_body()
    for joint in spec.joints:
        joint.armature = 0.02
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_position(kp=STIFF, kv=DAMPED)
    base.add_freejoint()
    spec.worldbody.add_body(name="gantry", mocap=True)
    spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="gantry",
                      name2=base.name, data=[0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0])  # fmt: skip
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 1], rgba=[0.8, 0.85, 0.9, 1],
                            contype=0, conaffinity=0)  # fmt: skip
    spec.add_texture(type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
                     rgb1=[1, 1, 1], width=8, height=48)  # fmt: skip
    spec.worldbody.add_light(
        pos=[0, 0, 4], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, castshadow=False
    )
    return spec.compile()


class Simulated:
    """The robot as it moves; ``errors`` are those of its joints, rad, where each target was reached for."""

    def __init__(self, model):
        self.model, self.data, self.errors, self.begun_ns = model, mujoco.MjData(model), [], None
        motors = range(model.nu)
        self.angle_of = {
            model.actuator(k).name: model.jnt_qposadr[model.actuator_trnid[k, 0]] for k in motors
        }

    def follow(self, pose):
        """Aim at a pose, and live until its instant."""
        data, base, at = self.data, pose.get("base"), list(self.angle_of.values())
        targets = np.array([pose["joints"][name] for name in self.angle_of])
        rates = np.array([pose["rates"][name] for name in self.angle_of])
        data.mocap_quat[0] = base["orientation"] if base else [1, 0, 0, 0]
        if self.begun_ns is None:
            self.begun_ns = pose["t_ns"]
            data.mocap_pos[0] = [0, 0, base["position"][2] if base else 1]
            data.qpos[:7] = np.concatenate([data.mocap_pos[0], data.mocap_quat[0]])
            data.qpos[at] = targets
            mujoco.mj_forward(self.model, data)
        data.ctrl[:] = targets + rates * DAMPED / STIFF  # damped against that rate, not against rest
        while data.time < (pose["t_ns"] - self.begun_ns) * 1e-9:
            mujoco.mj_step(self.model, data)
        self.errors.append(data.qpos[at] - targets)


def poses(port):
    """Yield datagrams until nothing comes for five seconds."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 23)  # pictures take longer than poses
    receiver.bind(("127.0.0.1", port))
    print(f"listening on {port}", flush=True)
    while True:
        try:
            yield json.loads(receiver.recv(65536))
        except TimeoutError:  # the motion has ended
            return
        receiver.settimeout(5)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("urdf", type=Path)
    parser.add_argument("--port", type=int, default=39700)
    parser.add_argument("--seconds", type=float, default=np.inf, help="of the motion; default: until it ends")
    parser.add_argument("--film", type=Path, help="a .gif; without a screen: MUJOCO_GL=egl or osmesa")
    parser.add_argument(
        "--azimuth", type=float, default=150, help="of the film: degrees from east, to the north"
    )
    asked = parser.parse_args()
    robot, pictures, camera = Simulated(model_of(asked.urdf)), [], mujoco.MjvCamera()
    renderer = mujoco.Renderer(robot.model, *SIZE) if asked.film else None
    camera.distance, camera.azimuth, camera.elevation, camera.lookat = 1.8, asked.azimuth, -8, [0, 0, 0.5]
    with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C ends the motion; what came until then is reported
        for pose in poses(asked.port):
            robot.follow(pose)
            if renderer and robot.data.time >= len(pictures) * PICTURE_S:
                renderer.update_scene(robot.data, camera)
                pictures.append(renderer.render())
            if robot.data.time >= asked.seconds:
                break
    if not robot.errors:
        raise SystemExit("no pose came: start the gateway with the output of examples/README.md first")
    if pictures:
        from PIL import Image  # noqa: PLC0415 - for films alone

        first, *others = (Image.fromarray(picture).quantize(64) for picture in pictures)
        first.save(asked.film, save_all=True, append_images=others, duration=1000 * PICTURE_S, loop=0)
    off = np.degrees(np.abs(robot.errors))
    print(
        f"{len(off)} poses; joints off by {off.mean():.2f}°, 95 % by less than {np.percentile(off, 95):.2f}°"
    )


if __name__ == "__main__":
    main()
