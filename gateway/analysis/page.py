"""An analysis as one HTML page that loads nothing from elsewhere."""

from __future__ import annotations

import html
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gateway.analysis import graphs
from gateway.analysis.analysing import Analysis
from gateway.errors import GatewayError
from gateway.report.drawing import require_matplotlib
from gateway.report.elements import document, picture, table, tiles


def write_page(found: Analysis, target: Path) -> None:
    """Raises ``GatewayError`` without matplotlib, or when it cannot be written."""
    require_matplotlib()
    try:
        target.write_text(page(found), encoding="utf-8")
    except OSError as error:
        raise GatewayError(f"{target} cannot be written: {error.strerror}") from error


def page(found: Analysis) -> str:
    """The page as text."""
    return document(f"Analysis of {found.name}", "\n".join(_sections(found)))


def _sections(found: Analysis) -> Iterator[str]:
    yield f"<h1>{html.escape(found.name)}</h1>"
    yield f'<p class="sub">{html.escape(_subtitle(found))}</p>'
    yield _tiles(found)
    yield "".join(f"<p>{html.escape(note)}</p>" for note in found.notes)
    if found.floor.force.any():
        yield "<h2>Floor</h2>" + picture(graphs.floor(found), "floor force on each foot over time")
    yield "<h2>Centre of mass</h2>" + picture(graphs.centre_of_mass(found), "path of the centre of mass")
    if found.skeleton.joints:
        yield "<h2>Torques, N m/kg</h2>" + _torque_table(found)
        yield picture(graphs.torques(found), "torques of every joint over time")
        yield "<h2>Powers, W/kg</h2>" + picture(graphs.powers(found), "powers of every joint over time")
        yield "<h2>Joint angles, °</h2>" + picture(graphs.angles(found), "joint angles over time")
        yield "<h2>Angular velocities, °/s</h2>" + picture(graphs.rates(found), "rates of the joint angles")


def _subtitle(found: Analysis) -> str:
    cutoff = found.motion.cutoff_hz
    smoothed = "as recorded" if cutoff is None else f"low-pass {cutoff:g} Hz without lag"
    return f"body {found.skeleton.name} · {found.inertia.body_kg:g} kg · {smoothed}"


def _tiles(found: Analysis) -> str:
    speed = np.linalg.norm(found.dynamics.centre_of_mass_velocity[:, :2], axis=1)
    up = found.floor.total()[:, 2] / found.weight_n
    left = np.sqrt(np.mean(np.sum(found.dynamics.residual_force**2, axis=1))) / found.weight_n
    return tiles(
        [
            (f"{found.time_s[-1]:.1f} s", "duration"),
            (f"{speed.mean():.2f} m/s", "mean speed over ground"),
            (f"{up.max():.2f} ×" if len(found.floor.segments) else "–", "weight, largest floor force"),
            (f"{100 * left:.1f} %", "of weight left over at the root (RMS)"),
        ]
    )


def _torque_table(found: Analysis) -> str:
    rows = [
        [
            joint.name.replace("_", " "),
            angle.name.replace("_", " "),
            f"{np.degrees(found.angles[:, j, k]).min():.0f} … {np.degrees(found.angles[:, j, k]).max():.0f}",
            f"{found.torques[:, j, k].min():.1f}",
            f"{found.torques[:, j, k].max():.1f}",
            f"{np.abs(found.torques[:, j, k]).max() / found.inertia.body_kg:.2f}",
        ]
        for j, joint in enumerate(found.skeleton.joints)
        for k, angle in enumerate(joint.angles)
    ]
    heads = ("joint", "movement", "range °", "least N m", "most N m", "largest N m/kg")
    return table(heads, rows, n_texts=2)
