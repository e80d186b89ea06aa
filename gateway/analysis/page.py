"""An analysis as one HTML page that loads nothing from elsewhere."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from devices.normal_gait import SOURCE
from gateway.analysis import graphs
from gateway.analysis.analysing import Analysis
from gateway.analysis.drawing import draw, scene_of
from gateway.analysis.drawing import png as drawn_png
from gateway.analysis.muscles import MuscleResult
from gateway.frames import FloatArray
from gateway.report.elements import document, picture, table, tiles
from gateway.support.extras import require_package
from gateway.support.whole_files import writing

_PICTURES = 3
_GAIT_HEADINGS = {"deg": "Angles, °", "n_m_per_kg": "Torques, N m/kg", "w_per_kg": "Powers, W/kg"}
_FULL = 0.99
"""Activity from which a muscle is at its largest."""


def write_page(found: Analysis, muscles: MuscleResult | None, target: Path, film: Path | None = None) -> None:
    """Write an analysis as one page of HTML. film: goes into the page.

    Raises ``GatewayError`` without matplotlib, or when it cannot be written.
    """
    require_package("matplotlib")
    with writing(target):
        target.write_text(page(found, muscles, film), encoding="utf-8")


def page(found: Analysis, muscles: MuscleResult | None = None, film: Path | None = None) -> str:
    """Return the page as text."""
    return document(f"Analysis of {found.name}", "\n".join(_sections(found, muscles, film)))


def _sections(found: Analysis, muscles: MuscleResult | None, film: Path | None) -> Iterator[str]:
    yield f"<h1>{html.escape(found.name)}</h1>"
    yield f'<p class="sub">{html.escape(_subtitle(found))}</p>'
    yield _tiles(found)
    yield "".join(f"<p>{html.escape(note)}</p>" for note in found.notes)
    yield from _pictures(found, muscles, film)
    yield from _gait(found)
    if found.skeleton.joints:
        yield _stance_note(found)
        yield "<h2>Joint angles, °</h2>" + picture(graphs.angles(found), "joint angles over time")
        yield "<h2>Torques, N m/kg</h2>" + _torque_table(found)
        yield picture(graphs.torques(found), "torques of every joint over time")
        yield "<h2>Powers, W/kg</h2>" + picture(graphs.powers(found), "powers of every joint over time")
    if found.floor.force.any():
        yield "<h2>Floor</h2>" + picture(graphs.floor(found), "floor force on each foot over time")
    part = "" if found.is_whole else " of the part of the person that is there"
    yield f"<h2>Centre of mass{part}</h2>"
    yield picture(graphs.centre_of_mass(found), "path of the centre of mass")
    if muscles is not None:
        yield "<h2>Muscles: activity</h2>" + picture(graphs.muscle_map(found, muscles), "activity of muscles")
        yield "<h2>Muscles: tension, N</h2>" + picture(graphs.tensions(found, muscles), "tension of muscles")
        yield _muscle_note(muscles)
    if found.skeleton.joints:
        yield "<h2>Angular velocities, °/s</h2>" + picture(graphs.rates(found), "rates of the joint angles")


def _pictures(found: Analysis, muscles: MuscleResult | None, film: Path | None) -> Iterator[str]:
    """Return the film, or single pictures of it where there is none."""
    if film is not None:
        data = base64.b64encode(film.read_bytes()).decode()
        yield f'<h2>Motion</h2><video controls loop muted src="data:video/webm;base64,{data}"></video>'
    elif muscles is not None:
        scene = scene_of(found)
        frames = np.linspace(0, len(found.time_s) - 1, 2 * _PICTURES + 1)[1::2].astype(int)
        drawn = np.hstack([draw(found, muscles, frame, scene) for frame in frames.tolist()])
        yield "<h2>Motion</h2>" + picture(drawn_png(drawn), "body and muscles at three instants")


def _gait(found: Analysis) -> Iterator[str]:
    """Return strides as figures, and curves by percent of them; nothing where nobody walks."""
    if not found.strides:
        return
    yield "<h2>Gait</h2>" + _stride_table(found)
    for unit, heading in _GAIT_HEADINGS.items():
        curves = graphs.gait(found, unit)
        if curves is not None:
            yield f"<h3>{heading}, by percent of the stride</h3>"
            yield picture(curves, f"{heading} by percent of the stride")
    yield (
        f"<p>Thin: single strides, from strike to strike; thick: their mean. Grey: {html.escape(SOURCE)}, "
        "mean and one standard deviation. Its hips are told against a pelvis of markers; where the neutral "
        "posture set the axes they show about 10° less.</p>"
    )


def _stance_note(found: Analysis) -> str:
    return "<p>Shaded: the foot of that side stands.</p>" if found.strides else ""


def _stride_table(found: Analysis) -> str:
    rows = []
    for foot in dict.fromkeys(stride.foot for stride in found.strides):
        own = [stride for stride in found.strides if stride.foot == foot]
        rows.append(
            [
                foot.replace("_", " "),
                str(len(own)),
                _spread([stride.duration_s for stride in own], 2),
                _spread([120.0 / stride.duration_s for stride in own], 0),
                _spread([stride.stance_percent for stride in own], 0),
                _spread([stride.length_m for stride in own], 2),
                _spread([stride.speed_m_per_s for stride in own], 2),
                ", ".join(sorted({stride.source for stride in own})),
            ]
        )
    heads = ("foot", "strides", "duration s", "steps a minute", "stance %", "length m", "speed m/s", "force")
    return table(heads, rows)


def _spread(values: list[float], digits: int) -> str:
    """Return the mean, and standard deviation where there are several."""
    deviation = f" ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{deviation}"


def _extremes(torque: FloatArray, kg: float) -> tuple[str, str, str]:
    """Return least, most and largest for each kilogram, of what is known of a torque (F,)."""
    known = torque[np.isfinite(torque)]
    if not len(known):
        return "–", "–", "–"
    return f"{known.min():.1f}", f"{known.max():.1f}", f"{np.abs(known).max() / kg:.2f}"


def _muscle_note(muscles: MuscleResult) -> str:
    left = float(np.sqrt(np.mean(muscles.left**2)))
    full = 100.0 * float((muscles.activity > _FULL).any(axis=1).mean())
    return (
        f"<p>{len(muscles.names)} muscles against {len(muscles.torques)} torques; {left:.2f} N m RMS of them "
        f"are left to others. In {full:.0f} % of the frames a muscle pulls with all its force: there the "
        "motion asks for more than the model has.</p>"
    )


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
    torques = found.known_torques
    rows = [
        [
            joint.name.replace("_", " "),
            angle.name.replace("_", " "),
            f"{np.degrees(found.angles[:, j, k]).min():.0f} … {np.degrees(found.angles[:, j, k]).max():.0f}",
            *_extremes(torques[:, j, k], found.inertia.body_kg),
        ]
        for j, joint in enumerate(found.skeleton.joints)
        for k, angle in enumerate(joint.angles)
    ]
    heads = ("joint", "movement", "range °", "least N m", "most N m", "largest N m/kg")
    return table(heads, rows, n_texts=2)
