"""``mocap-gateway body``: look at bodies, check them, fit them to a person, import robots."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml
from pydantic import ValidationError
from rich.console import Console
from rich.table import Table
from rich.tree import Tree

from gateway.body.anthropometry import Subject, scaled, segment_masses
from gateway.body.body_file import load_body
from gateway.body.joints import WORLD, Joint
from gateway.body.skeleton import Skeleton
from gateway.body.urdf import import_urdf
from gateway.cli.options import AsJson, ReplaceFiles, refuse_existing
from gateway.cli.terminal import wide_console
from gateway.errors import GatewayError
from gateway.support.settings_files import (
    as_shown,
    find_file,
    load_yaml,
    message_of,
    read_text,
    shipped_folder,
)
from gateway.support.whole_files import write_whole, writing

body_app = typer.Typer(
    help="Bodies: segments, joints, lengths.",
    epilog="Examples: mocap-gateway body list; mocap-gateway body show human_17 --height 1.82",
    no_args_is_help=True,
)

BodyName = Annotated[str, typer.Argument(help="A shipped body or a body file.")]
Height = Annotated[float | None, typer.Option(help="Stature of the person, m.")]
Mass = Annotated[float | None, typer.Option(help="Body mass, kg.")]
Sex = Annotated[str | None, typer.Option(help="female or male, for masses; default: the mean.")]
Lengths = Annotated[
    list[str] | None,
    typer.Option("--length", metavar="NAME=M", help="Measured, m: thigh=0.43, hip_width=0.20; repeatable."),
]
Output = Annotated[Path, typer.Option("--output", "-o", help="Body file to write.")]


@body_app.command("list", epilog="Example: mocap-gateway body list")
def list_bodies() -> None:
    """List the shipped bodies."""
    table = Table("body", "segments", "joints", "stature m")
    for path in sorted((shipped_folder() / "bodies").glob("*.yaml")):
        body = load_body(str(path))
        stature = f"{body.stature_m:g}" if body.stature_m else "–"
        table.add_row(path.stem, str(body.n_segments), str(len(body.joints)), stature)
    Console().print(table)


@body_app.command(
    epilog="Example: mocap-gateway body show human_17 --height 1.82 --mass 78 --length thigh=0.44"
)
def show(
    body: BodyName,
    height: Height = None,
    mass: Mass = None,
    sex: Sex = None,
    length: Lengths = None,
    as_json: AsJson = False,
) -> None:
    """Show the tree of segments with lengths (and masses), and the joints with their angles and limits."""
    subject = _subject(height, mass, sex, length)
    skeleton = scaled(load_body(body), subject, "body")
    masses = None if mass is None else segment_masses(skeleton, mass, subject.sex)
    if as_json:
        typer.echo(json.dumps(_as_json(skeleton, masses)))
        return
    _print_body(skeleton, masses)


@body_app.command(epilog="Example: mocap-gateway body check my_body.yaml")
def check(body: BodyName) -> None:
    """Check a body file; every mistake is named with its place and the remedy."""
    skeleton = load_body(body)
    typer.echo(f"{body}: {skeleton.n_segments} segments, {len(skeleton.joints)} joints, all as it should be")


@body_app.command(
    epilog="Example: mocap-gateway body scale human_17 --height 1.62 --length shank=0.38 -o anna.yaml"
)
def scale(
    body: BodyName, output: Output, height: Height = None, length: Lengths = None, force: ReplaceFiles = False
) -> None:
    """Write a body file with a person's lengths.

    A rig file can do the same for itself: `subject: {height_m: 1.62, lengths: {shank: 0.38}}`.
    """
    subject = _subject(height, None, None, length)
    path = find_file(body, "bodies")
    skeleton = scaled(load_body(body), subject, "body")
    content: dict[str, Any] = load_yaml(path)
    content["name"] = output.stem
    if skeleton.stature_m is not None:
        content["stature_m"] = skeleton.stature_m
    for i, segment in enumerate(content["segments"]):
        segment["tip"] = np.round(skeleton.tips[i], 6).tolist()
        if segment.get("parent") is not None:
            segment["joint"] = np.round(skeleton.offsets[i], 6).tolist()
        points = [point for carrier, point in skeleton.contacts if carrier == i]
        if points:
            segment["contacts"] = np.round(points, 6).tolist()
    _write(output, f"# {path.stem}, scaled.\n", content, force)


@body_app.command(epilog="Example: mocap-gateway body measure -c my.yaml --height 1.82 --length thigh=0.44")
def measure(
    config: Annotated[Path, typer.Option("--config", "-c", help="Configuration of the gateway.")],
    height: Height = None,
    mass: Mass = None,
    length: Lengths = None,
) -> None:
    """Keep the measures of who wears the suit in the rig file of a configuration; show them.

    They scale the body. Of a shipped rig `<rig>.worn.yaml` is written, which the configuration then names. A
    running gateway is asked the same by `calibration/measure`, or reads it anew on SIGHUP.
    """
    from gateway.calibration.kept_rig import KeptRig, measured
    from gateway.settings import load_gateway_settings

    rig = KeptRig(load_gateway_settings(config).rig, config)
    subject = _subject(height, mass, None, length)
    if changes := measured(subject.height_m, subject.mass_kg, subject.lengths):
        rig.keep_subject(changes)
        rig.name_in_configuration()
        typer.echo(f"kept in {rig.target}", err=True)
    typer.echo(json.dumps(rig.subject().as_json()))


@body_app.command("import-urdf", epilog="Example: mocap-gateway body import-urdf arm.urdf -o arm.yaml")
def import_robot(
    urdf: Annotated[Path, typer.Argument(help="URDF file (expanded, without xacro).")],
    output: Output,
    floating: Annotated[
        bool, typer.Option("--floating", help="The base moves, and carries a module of its own.")
    ] = False,
    force: ReplaceFiles = False,
) -> None:
    """Make a body file of a robot's URDF: links with what is fixed to them, joints, axes and limits."""
    refuse_existing(output, force, source=urdf)
    robot = import_urdf(read_text(urdf), str(urdf), has_fixed_base=not floating)
    _write(output, f"# Imported from {urdf.name}.\n", robot.content, force)
    for note in robot.notes:
        typer.echo(f"note: {note}", err=True)
    skeleton = load_body(str(output))
    _print_body(skeleton, None)


_WIDEST = 10_000
"""Columns that no tree of segments needs."""

_OPTIONS: dict[str | int, str] = {
    "height_m": "--height (m)",
    "mass_kg": "--mass (kg)",
    "sex": "--sex",
    "lengths": "--length (m)",
}
"""What sets each field of a subject."""


def _subject(height: float | None, mass: float | None, sex: str | None, lengths: list[str] | None) -> Subject:
    measured: dict[str, str] = {}
    for text in lengths or ():
        name, equals, value = text.partition("=")
        if not equals:
            raise GatewayError(f"--length {text}: write NAME=METRES, such as thigh=0.43")
        measured[name] = value
    try:
        return Subject.model_validate({"height_m": height, "mass_kg": mass, "sex": sex, "lengths": measured})
    except ValidationError as error:
        problem = error.errors()[0]
        option = _OPTIONS[problem["loc"][0]]
        raise GatewayError(f"{option} {as_shown(problem['input'])}: {message_of(problem)}") from error


def _write(path: Path, head: str, content: dict[str, Any], force: bool) -> None:
    refuse_existing(path, force)
    text = head + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    with writing(path):
        write_whole(path, text.encode())
    typer.echo(f"written to {path}")


def _print_body(skeleton: Skeleton, masses: np.ndarray | None) -> None:
    tree = _tree(skeleton, masses)
    # A long chain is wider than any terminal, which breaks its lines; narrower ones would be cut off.
    wide_console(Console(width=_WIDEST).measure(tree).maximum).print(tree)
    if skeleton.joints:
        Console().print(_joint_table(skeleton))


def _tree(skeleton: Skeleton, masses: np.ndarray | None) -> Tree:
    stature = f", stature {skeleton.stature_m:.2f} m" if skeleton.stature_m else ""
    root = Tree(f"[bold]{skeleton.name}[/bold]: {skeleton.n_segments} segments{stature}")
    branches: dict[int, Tree] = {-1: root}
    for i, name in enumerate(skeleton.segment_names):
        mass = "" if masses is None or math.isnan(masses[i]) else f"  {masses[i]:.2f} kg"
        text = f"{name}  {1000 * np.linalg.norm(skeleton.tips[i]):.0f} mm{mass}"
        branches[i] = branches[int(skeleton.parents[i])].add(text)
    return root


def _joint_table(skeleton: Skeleton) -> Table:
    table = Table("joint", "turns", "against", "kind", "sequence", "angles (limits °)")
    for joint in skeleton.joints:
        proximal = "world" if joint.proximal == WORLD else skeleton.segment_names[joint.proximal]
        distal = skeleton.segment_names[joint.distal]
        table.add_row(joint.name, distal, proximal, joint.kind, joint.sequence, _angles(joint))
    return table


def _angles(joint: Joint) -> str:
    def limits(low: float, high: float) -> str:
        return f" ({math.degrees(low):.0f}…{math.degrees(high):.0f})" if math.isfinite(low) else ""

    return ", ".join(f"{angle.name}{limits(*angle.limits)}" for angle in joint.angles)


def _as_json(skeleton: Skeleton, masses: np.ndarray | None) -> dict[str, Any]:
    from gateway.contract.messages import describe_body

    described = describe_body(skeleton).model_dump(mode="json")
    described["stature_m"] = skeleton.stature_m
    if masses is not None:
        kilograms = [None if math.isnan(mass) else round(float(mass), 3) for mass in masses]
        described["mass_kg"] = dict(zip(skeleton.segment_names, kilograms, strict=True))
    return described
