"""Floor forces for OpenSim: force, place and torque of every foot, ``.mot``, and the external loads that name
them."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

import numpy as np

from gateway.analysis.analysing import Analysis
from gateway.frames import FloatArray
from gateway.recording.exporters.opensim_model import body_name

FORCES, LOADS = "ground_reaction.mot", "external_loads.xml"


def write_loads(found: Analysis, folder: Path) -> list[Path]:
    """Write both files into a folder that exists; none for a body without feet. Raises ``OSError``."""
    names = [body_name(found.skeleton.segment_names[s]) for s in found.floor.segments.tolist()]
    if not names:
        return []
    forces, loads = folder / FORCES, folder / LOADS
    _write_forces(found, names, forces)
    _write_external_loads(names, loads)
    return [forces, loads]


def _write_forces(found: Analysis, names: list[str], path: Path) -> None:
    place = np.nan_to_num(found.floor.centre_of_pressure())
    force = np.where(place.any(axis=-1, keepdims=True), found.floor.force, 0.0)
    torque = np.where(force.any(axis=-1, keepdims=True), found.floor.moment - np.cross(place, force), 0.0)
    labels, columns = ["time"], [found.time_s[:, None]]
    for c, name in enumerate(names):
        labels += [f"{name}_ground_force_{kind}{axis}" for kind in "vp" for axis in "xyz"]
        labels += [f"{name}_ground_torque_{axis}" for axis in "xyz"]
        columns += [_y_up(force[:, c]), _y_up(place[:, c]), _y_up(torque[:, c])]
    table = np.concatenate(columns, axis=1)
    head = [
        path.stem,
        "version=1",
        f"nRows={len(table)}",
        f"nColumns={len(labels)}",
        "inDegrees=yes",
        "endheader",
    ]
    with path.open("w", encoding="utf-8") as file:
        file.write("\n".join([*head, "\t".join(labels)]) + "\n")
        np.savetxt(file, table, fmt="%.8f", delimiter="\t")


def _y_up(vectors: FloatArray) -> FloatArray:
    """Return (F, 3) of a world with z up, as exports turn it."""
    return np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=1)


def _write_external_loads(names: list[str], path: Path) -> None:
    document = Element("OpenSimDocument", Version="40000")
    loads = SubElement(document, "ExternalLoads", name="externalloads")
    objects = SubElement(loads, "objects")
    for name in names:
        force = SubElement(objects, "ExternalForce", name=f"floor_on_{name}")
        for entry, text in {
            "applied_to_body": name, "force_expressed_in_body": "ground", "point_expressed_in_body": "ground",
            "force_identifier": f"{name}_ground_force_v", "point_identifier": f"{name}_ground_force_p",
            "torque_identifier": f"{name}_ground_torque_",
        }.items():  # fmt: skip
            SubElement(force, entry).text = text
    SubElement(loads, "datafile").text = FORCES
    indent(document)
    with path.open("wb") as file:
        ElementTree(document).write(file, encoding="utf-8", xml_declaration=True)
