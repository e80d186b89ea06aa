"""The graphs of an analysis, as PNG bytes. Needs matplotlib (extra ``plot``)."""

from __future__ import annotations

import numpy as np

from gateway.analysis.analysing import Analysis
from gateway.analysis.cycles import PERCENT, foot_of, stance_spans
from gateway.analysis.gait_curves import GaitCurve, gait_curves
from gateway.analysis.muscles import MuscleResult
from gateway.frames import FloatArray
from gateway.report.elements import LINES, panels, png, small_multiples

_MOST_MUSCLES = 24
GAIT_COLUMNS = 3
SIDE_COLOURS = {"left": "#a03c96", "right": "#00789b"}
"""Those of the film."""


def angles(found: Analysis) -> bytes:
    """Draw the angles of every joint, degrees."""
    return _by_joint(found, np.degrees(found.angles))


def rates(found: Analysis) -> bytes:
    """Draw the rates of every joint's angles, degrees a second."""
    return _by_joint(found, np.degrees(found.angle_rates))


def torques(found: Analysis) -> bytes:
    """Draw the torques of every joint, N m a kilogram of the person."""
    return _by_joint(found, found.known_torques / found.inertia.body_kg)


def powers(found: Analysis) -> bytes:
    """Draw the power of every joint, W a kilogram."""
    power = found.known_power / found.inertia.body_kg
    return small_multiples(
        found.time_s,
        [(joint.name, power[:, j : j + 1], ("power",)) for j, joint in enumerate(found.skeleton.joints)],
        _stances(found),
    )


def gait(found: Analysis, unit: str) -> bytes | None:
    """Draw curves of a unit (``deg``, ``n_m_per_kg``, ``w_per_kg``) by percent of the stride, left and
    right over the published band; None where no stride tells any."""
    curves = [curve for curve in gait_curves(found) if curve.unit == unit]
    titles = list(dict.fromkeys(curve.title for curve in curves))
    if not titles:
        return None
    figure, axes = panels(len(titles), 2.2 * -(-len(titles) // GAIT_COLUMNS) + 0.5, GAIT_COLUMNS)
    for curve in curves:
        _gait_panel(axes[titles.index(curve.title)], curve)
    for side, colour in SIDE_COLOURS.items():
        off = [each.stance_percent for each in found.strides if each.foot.startswith(side)]
        for panel in axes[: len(titles)] if off else []:
            panel.axvline(float(np.mean(off)), color=colour, lw=0.8, ls="--", label=f"{side} foot lifts off")
    for panel, title in zip(axes, titles, strict=False):
        panel.set_title(title, fontsize=8)
        panel.set_xlim(0, 100)
        panel.set_xlabel("% of the stride", fontsize=7)
    entries: dict[str, object] = {}
    for panel in axes:
        handles, labels = panel.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(entries.values(), entries.keys(), loc="outside right upper", fontsize=6)
    return png(figure)


def _gait_panel(panel: object, curve: GaitCurve) -> None:
    """Plot every stride thin, their mean thick, and the published band below them."""
    side = "left" if curve.is_left else "right"
    if curve.band is not None and not panel.collections:  # type: ignore[attr-defined]
        percent, mean, deviation = curve.band.T
        panel.fill_between(  # type: ignore[attr-defined]
            percent, mean - deviation, mean + deviation, color="#d5d5d5", lw=0, label="published, ±1 SD"
        )
    for own in curve.cycles.curves:
        panel.plot(PERCENT, own, lw=0.4, alpha=0.6, color=SIDE_COLOURS[side])  # type: ignore[attr-defined]
    panel.plot(PERCENT, curve.cycles.mean, lw=1.6, color=SIDE_COLOURS[side], label=side)  # type: ignore[attr-defined]


def floor(found: Analysis) -> bytes:
    """Return the force on each foot as a share of weight, and what no force explains."""
    count = len(found.floor.segments)
    figure, axes = panels(count + 1, 2.6)
    for c, segment in enumerate(found.floor.segments.tolist()):
        _lines(axes[c], found.time_s, found.floor.force[:, c] / found.weight_n)
        axes[c].set_title(found.skeleton.segment_names[segment].replace("_", " "), fontsize=8)
    _lines(axes[count], found.time_s, found.dynamics.residual_force / found.weight_n)
    axes[count].set_title("left over at the root", fontsize=8)
    axes[0].set_ylabel("of weight", fontsize=7)
    return png(figure)


def centre_of_mass(found: Analysis) -> bytes:
    """Draw the path of the centre of mass from where it began, and its velocity."""
    figure, axes = panels(2, 2.4)
    path = found.dynamics.centre_of_mass
    _lines(axes[0], found.time_s, path - path[0])
    _lines(axes[1], found.time_s, found.dynamics.centre_of_mass_velocity)
    whose = (
        "" if found.is_whole else f" of the {100 * found.inertia.share:.0f} % of the person that are there"
    )
    axes[0].set_title(f"centre of mass{whose} from where it began, m", fontsize=8)
    axes[1].set_title("its velocity, m/s", fontsize=8)
    return png(figure)


def muscle_map(found: Analysis, muscles: MuscleResult) -> bytes:
    """Return the activity of all muscles over time, a row a muscle."""
    figure, axes = panels(1, 0.115 * len(muscles.names) + 1.0)
    image = axes[0].imshow(
        muscles.activity.T, aspect="auto", cmap="YlOrRd", vmin=0, vmax=1, interpolation="nearest",
        extent=(float(found.time_s[0]), float(found.time_s[-1]), len(muscles.names) - 0.5, -0.5),
    )  # fmt: skip
    axes[0].set_yticks(range(len(muscles.names)), muscles.names, fontsize=4.5)
    axes[0].set_xlabel("s", fontsize=7)
    figure.colorbar(image, ax=axes[0], label="activity", pad=0.01)
    return png(figure)


def tensions(found: Analysis, muscles: MuscleResult) -> bytes:
    """Draw the tension of the muscles that pull most, left and right together, N."""
    stems = [name[:-2] for name in muscles.names if name.endswith("_l")]
    largest = {
        stem: max(muscles.tension[:, muscles.names.index(f"{stem}_{side}")].max() for side in "lr")
        for stem in stems
    }
    chosen = sorted(sorted(stems, key=lambda stem: -largest[stem])[:_MOST_MUSCLES])
    shown = [
        (
            stem,
            np.stack([muscles.tension[:, muscles.names.index(f"{stem}_{side}")] for side in "lr"], axis=1),
            ("left", "right"),
        )
        for stem in chosen
    ]
    return small_multiples(found.time_s, shown)


def _by_joint(found: Analysis, values: FloatArray) -> bytes:
    shown = [
        (joint.name, values[:, j, : len(joint.angles)], tuple(angle.name for angle in joint.angles))
        for j, joint in enumerate(found.skeleton.joints)
    ]
    return small_multiples(found.time_s, shown, _stances(found))


def _stances(found: Analysis) -> dict[str, list[tuple[float, float]]]:
    """Return from when until when the foot of a joint's side stands, s, by the joint's name."""
    spans = stance_spans(found.skeleton, found.floor, found.time_s)
    feet = {joint.name: foot_of(found.skeleton, j) for j, joint in enumerate(found.skeleton.joints)}
    return {name: spans[foot] for name, foot in feet.items() if foot in spans}


def _lines(axes: object, time_s: FloatArray, values: FloatArray) -> None:
    """Plot the three components of values (F, 3) over time."""
    for i, name in enumerate(("x east", "y north", "z up")):
        axes.plot(time_s, values[:, i], lw=0.9, color=LINES[i], label=name)  # type: ignore[attr-defined]
    axes.set_xlabel("s", fontsize=7)  # type: ignore[attr-defined]
    axes.legend(fontsize=6, framealpha=0.6)  # type: ignore[attr-defined]
