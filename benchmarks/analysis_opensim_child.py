"""Runs in a Python that has OpenSim: builds the body it is told of, and asks OpenSim for the same things.

``python analysis_opensim_child.py FOLDER``: reads ``task.json`` there, writes ``answer.json``. Needs nothing
of this project.
"""

import json
import math
import sys
import time
from pathlib import Path

import opensim as osim

CHEAP_N_M = 1000.0
"""Largest of what does the work of joints that no muscle is asked for."""


def vector(values):
    return osim.Vec3(*(float(value) for value in values))


def build(task):
    """The model, without actuators."""
    model = osim.Model()
    model.setName("peer")
    model.setGravity(vector(task["gravity"]))
    bodies = {}
    for entry in task["bodies"]:
        inertia = osim.Inertia(*(float(value) for value in entry["inertia"]))
        body = osim.Body(entry["name"], entry["mass"], vector(entry["centre"]), inertia)
        model.addBody(body)
        bodies[entry["name"]] = body
        parent = model.getGround() if entry["parent"] is None else bodies[entry["parent"]]
        zero = vector([0, 0, 0])
        joint = osim.CustomJoint(
            entry["name"], parent, vector(entry["offset"]), zero, body, zero, zero, free_axes(entry)
        )
        model.addJoint(joint)
    return model, bodies


def free_axes(entry):
    """Rotations about x, y, z in turn, and shifts where there are any: as a custom joint, since only there
    OpenSim's speeds are the rates of the angles, as its tools take them."""
    axes = osim.SpatialTransform()
    for index, name in enumerate(entry["coordinates"]):
        axis = axes.updTransformAxis(index)
        names = osim.ArrayStr()
        names.append(name)
        axis.setCoordinateNames(names)
        axis.set_axis(vector([index % 3 == k for k in range(3)]))
        axis.set_function(osim.LinearFunction(1.0, 0.0))
    return axes


def add_wires(model, bodies, wires):
    """Every muscle as an ideal puller along its wire."""
    for wire in wires:
        pull = osim.PathActuator()
        pull.setName(wire["name"])
        pull.setOptimalForce(wire["peak"])
        pull.setMinControl(0.0)
        pull.setMaxControl(1.0)
        path = osim.GeometryPath.safeDownCast(pull.updPath())
        for index, point in enumerate(wire["points"]):
            name = f"{wire['name']}_{index}"
            if point["kind"] == "point":
                path.appendNewPathPoint(name, bodies[point["body"]], vector(point["place"]))
            else:
                path.updPathPointSet().adoptAndAppend(moving(model, bodies, point, name))
        model.addForce(pull)


def moving(model, bodies, point, name):
    """A point of the kneecap, that moves on the thigh with the knee."""
    made = osim.MovingPathPoint()
    made.setName(name)
    made.setParentFrame(bodies[point["body"]])
    coordinate = model.getCoordinateSet().get(point["coordinate"])
    for axis, values in zip("xyz", point["places"], strict=True):
        spline = osim.SimmSpline()
        for at, value in zip(point["angles"], values, strict=True):
            spline.addPoint(at, value)
        getattr(made, f"set_{axis}_location")(spline)
        getattr(made, f"connectSocket_{axis}_coordinate")(coordinate)
    return made


def add_helpers(model, asked):
    """What is left of torques: as dear as ours for those that muscles are asked for, else all but free."""
    coordinates = model.getCoordinateSet()
    for index in range(coordinates.getSize()):
        name = coordinates.get(index).getName()
        helper = osim.CoordinateActuator(name)
        helper.setName(f"{name}_left")
        helper.setOptimalForce(1.0 if name in asked else CHEAP_N_M)
        helper.setMinControl(-math.inf)
        helper.setMaxControl(math.inf)
        model.addForce(helper)


def write_table(path, columns, rows):
    with path.open("w") as file:
        file.write(f"table\nversion=1\nnRows={len(rows)}\nnColumns={len(columns)}\ninDegrees=no\nendheader\n")
        file.write("\t".join(columns) + "\n")
        file.writelines("\t".join(f"{value:.12g}" for value in row) + "\n" for row in rows)


def read_table(path):
    lines = path.read_text().splitlines()
    begin = next(i for i, line in enumerate(lines) if line.strip() == "endheader") + 1
    heads = lines[begin].split()
    rows = [[float(cell) for cell in line.split()] for line in lines[begin + 1 :] if line.strip()]
    return {head: [row[i] for row in rows] for i, head in enumerate(heads)}


def write_loads(folder, task):
    """Floor forces, as moments about the world's origin."""
    heads, loads = ["time"], osim.ExternalLoads()
    for name in task["feet"]:
        heads += [f"{name}_{kind}_{axis}" for kind in ("v", "p", "t") for axis in "xyz"]
        load = osim.ExternalForce()
        load.setName(name)
        load.set_applied_to_body(name)
        load.set_force_expressed_in_body("ground")
        load.set_point_expressed_in_body("ground")
        load.set_force_identifier(f"{name}_v_")
        load.set_point_identifier(f"{name}_p_")
        load.set_torque_identifier(f"{name}_t_")
        loads.cloneAndAppend(load)
    write_table(folder / "floor.sto", heads, task["floor"])
    loads.setDataFileName(str(folder / "floor.sto"))
    loads.printToXML(str(folder / "loads.xml"))


def from_files(tool, folder):
    """Motion and loads as they were written, unfiltered; results beside them."""
    tool.setCoordinatesFileName(str(folder / "motion.sto"))
    tool.setExternalLoadsFileName(str(folder / "loads.xml"))
    tool.setLowpassCutoffFrequency(-1)
    tool.setResultsDir(str(folder))


def inverse_dynamics(folder, task):
    tool = osim.InverseDynamicsTool()
    tool.setModelFileName(str(folder / "plain.osim"))
    from_files(tool, folder)
    tool.setStartTime(task["begin"])
    tool.setEndTime(task["end"])
    tool.setOutputGenForceFileName("torques.sto")
    begun = time.process_time()
    tool.run()
    return read_table(folder / "torques.sto"), time.process_time() - begun


def static_optimisation(folder, task):
    tool = osim.AnalyzeTool()
    tool.setName("peer")
    tool.setModelFilename(str(folder / "muscles.osim"))
    from_files(tool, folder)
    tool.setInitialTime(task["optimise_begin"])
    tool.setFinalTime(task["optimise_end"])
    wanted = osim.StaticOptimization()
    wanted.setStartTime(task["optimise_begin"])
    wanted.setEndTime(task["optimise_end"])
    wanted.setUseModelForceSet(True)
    wanted.setUseMusclePhysiology(False)
    wanted.setActivationExponent(2)
    tool.updAnalysisSet().cloneAndAppend(wanted)
    tool.printToXML(str(folder / "analyze.xml"))
    again = osim.AnalyzeTool(str(folder / "analyze.xml"))
    begun = time.process_time()
    again.run()
    spent = time.process_time() - begun
    return read_table(folder / "peer_StaticOptimization_force.sto"), spent


def main():
    folder = Path(sys.argv[1])
    task = json.loads((folder / "task.json").read_text())
    osim.Logger.setLevelString("error")
    model, _ = build(task)
    model.finalizeConnections()
    model.printToXML(str(folder / "plain.osim"))
    model, bodies = build(task)
    add_wires(model, bodies, task["wires"])
    add_helpers(model, task["asked"])
    model.finalizeConnections()
    model.printToXML(str(folder / "muscles.osim"))
    write_table(folder / "motion.sto", ["time", *task["columns"]], task["motion"])
    write_loads(folder, task)
    torques, torque_s = inverse_dynamics(folder, task)
    forces, force_s = static_optimisation(folder, task)
    answer = {"torques": torques, "torque_s": torque_s, "forces": forces, "force_s": force_s,
              "version": osim.GetVersion()}  # fmt: skip
    (folder / "answer.json").write_text(json.dumps(answer))


main()
