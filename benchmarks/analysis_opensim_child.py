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

LIGHT_KG = 1e-4
LENGTH_M = 0.4
"""Of cylinders that wires slide over."""
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
    for index, name in enumerate(entry["coordinates"]):  # body_rz or body_tx: about or along that axis
        axis = axes.updTransformAxis(index)
        names = osim.ArrayStr()
        names.append(name)
        axis.setCoordinateNames(names)
        axis.set_axis(vector([name[-1] == along for along in "xyz"]))
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
        wrapped = []
        for index, point in enumerate(wire["points"]):
            name = f"{wire['name']}_{index}"
            if point["kind"] == "point":
                path.appendNewPathPoint(name, bodies[point["body"]], vector(point["place"]))
            else:
                wrapped.append(around(bodies[point["body"]], point, name))
        for each in wrapped:
            path.addPathWrap(each)
        model.addForce(pull)


def around(body, point, name):
    """What a wire slides over, put onto its body."""
    made = osim.WrapSphere() if point["is_sphere"] else osim.WrapCylinder()
    made.setName(name)
    made.set_translation(vector(point["place"]))
    made.set_xyz_body_rotation(vector(point["turn"]))
    made.set_radius(point["radius"])
    if not point["is_sphere"]:
        made.set_length(LENGTH_M)
    body.addWrapObject(made)
    return made


def add_kneecaps(model, bodies, kneecaps):
    """Bodies of hardly any mass on the thighs, whose ways follow the knees by constraints. Points that move
    with a coordinate would not do: OpenSim's moment arm of a path with one is not its length's derivative."""
    zero = vector([0, 0, 0])
    for entry in kneecaps:
        body = osim.Body(entry["name"], LIGHT_KG, zero, osim.Inertia(*[LIGHT_KG] * 3))
        model.addBody(body)
        bodies[entry["name"]] = body
        axes = osim.SpatialTransform()
        for index, name in ((2, "rz"), (3, "tx"), (4, "ty")):
            names = osim.ArrayStr()
            names.append(f"{entry['name']}_{name}")
            axis = axes.updTransformAxis(index)
            axis.setCoordinateNames(names)
            axis.set_function(osim.LinearFunction(1.0, 0.0))
        thigh = bodies[entry["thigh"]]
        model.addJoint(osim.CustomJoint(entry["name"], thigh, zero, zero, body, zero, zero, axes))
        for name, values in entry["ways"].items():
            follow = osim.CoordinateCouplerConstraint()
            follow.setName(f"{entry['name']}_{name}_follows")
            leads = osim.ArrayStr()
            leads.append(entry["coordinate"])
            follow.setIndependentCoordinateNames(leads)
            follow.setDependentCoordinateName(f"{entry['name']}_{name}")
            follow.setFunction(way(entry["angles"], values))
            model.addConstraint(follow)


def way(angles, values):
    spline = osim.SimmSpline()
    for at, value in zip(angles, values, strict=True):
        spline.addPoint(at, value)
    return spline


def with_kneecaps(task, rows, begin):
    """Columns and rows of a motion with the kneecaps' coordinates. begin: of coordinates in a row."""
    columns, longer = list(task["columns"]), [list(row) for row in rows]
    for entry in task["kneecaps"]:
        leads = begin + task["columns"].index(entry["coordinate"])
        for name, values in entry["ways"].items():
            columns.append(f"{entry['name']}_{name}")
            spline = way(entry["angles"], values)
            for row in longer:
                at = osim.Vector(1, row[leads])
                row.append(spline.calcValue(at))
    return columns, longer


def add_helpers(model, columns, asked):
    """What is left of torques: as dear as ours for those that muscles are asked for, else all but free."""
    for name in columns:
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


def from_files(tool, folder, motion):
    """Motion and loads as they were written, unfiltered; results beside them."""
    tool.setCoordinatesFileName(str(folder / motion))
    tool.setExternalLoadsFileName(str(folder / "loads.xml"))
    tool.setLowpassCutoffFrequency(-1)
    tool.setResultsDir(str(folder))


def inverse_dynamics(folder, task):
    tool = osim.InverseDynamicsTool()
    tool.setModelFileName(str(folder / "plain.osim"))
    from_files(tool, folder, "motion.sto")
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
    from_files(tool, folder, "motion_kneecaps.sto")
    tool.setInitialTime(task["begin"])
    tool.setFinalTime(task["end"])
    wanted = osim.StaticOptimization()
    wanted.setStartTime(task["begin"])
    wanted.setEndTime(task["end"])
    wanted.setStepInterval(task["every"])
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


def moment_arms(model, task):
    """By muscle and asked coordinate, one value an instant of those that are told."""
    state = model.initSystem()
    coordinates = model.getCoordinateSet()
    found = {wire["name"]: {name: [] for name in task["asked"]} for wire in task["wires"]}
    columns, rows = with_kneecaps(task, task["arms_rows"], 0)
    for row in rows:
        for name, value in zip(columns, row, strict=True):
            coordinates.get(name).setValue(state, value, False)
        model.realizePosition(state)
        for wire in task["wires"]:
            pull = osim.PathActuator.safeDownCast(model.updForceSet().get(wire["name"]))
            for name in task["asked"]:
                arm = pull.computeMomentArm(state, coordinates.get(name))
                found[wire["name"]][name].append(arm)
    return found


def main():
    folder = Path(sys.argv[1])
    task = json.loads((folder / "task.json").read_text())
    osim.Logger.setLevelString("error")
    model, _ = build(task)
    model.finalizeConnections()
    model.printToXML(str(folder / "plain.osim"))
    model, bodies = build(task)
    add_kneecaps(model, bodies, task["kneecaps"])
    add_wires(model, bodies, task["wires"])
    add_helpers(model, task["columns"], task["asked"])
    model.finalizeConnections()
    model.printToXML(str(folder / "muscles.osim"))
    write_table(folder / "motion.sto", ["time", *task["columns"]], task["motion"])
    columns, rows = with_kneecaps(task, task["motion"], 1)
    write_table(folder / "motion_kneecaps.sto", ["time", *columns], rows)
    write_loads(folder, task)
    torques, torque_s = inverse_dynamics(folder, task)
    forces, force_s = static_optimisation(folder, task)
    arms = moment_arms(model, task)
    answer = {"arms": arms, "torques": torques, "torque_s": torque_s, "forces": forces, "force_s": force_s,
              "version": osim.GetVersion()}  # fmt: skip
    (folder / "answer.json").write_text(json.dumps(answer))


main()
