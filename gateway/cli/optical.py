"""``mocap-gateway optical``: markers of an optical system to a skeleton; fit a body, solve, play, serve."""

from __future__ import annotations

import asyncio
import json
import math
import signal
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Column, Table

from devices.links.qtm_link import DEFAULT_PORT
from gateway.body.skeleton import WornSuit
from gateway.cli.export import export
from gateway.cli.options import AsJson, Embedded, ReplaceFiles, refuse_existing, seconds_of, with_options
from gateway.cli.preparing import make_ready
from gateway.cli.replay import Brake, for_playing, print_outcome, speed_of
from gateway.cli.replay import play as play_link
from gateway.cli.terminal import progress_bar
from gateway.errors import GatewayError
from gateway.outputs.settings import PoseMap
from gateway.reconstruction import OFFLINE, OPTICAL
from gateway.recording.exporters.formats import FORMATS, check_formats
from gateway.settings import BodySettings, GatewaySettings, load_gateway_settings
from gateway.support.whole_files import writing

if TYPE_CHECKING:
    from devices.marker_files import MarkerTrial
    from gateway.reconstruction.optical.fitted_body import Fit
    from gateway.reconstruction.optical.fitting import FitOptions
    from gateway.recording.optical import SolvedTrial


Length = Annotated[
    list[str] | None,
    typer.Option(
        "--measure", metavar="NAME=METRES", help="A length of the person; without: as the files tell."
    ),
]
WandAngle = Annotated[
    list[str] | None,
    typer.Option(
        "--angle",
        metavar="NAME=DEGREES",
        help="By which a wand lies ahead of its joint's axis, such as left_thigh_rotation=8; without: as "
        "the files tell.",
    ),
]
Up = Annotated[
    str | None, typer.Option(help="Axis of the files that points up: x, y, z, or -z where z points down.")
]
Neutral = Annotated[
    str | None,
    typer.Option(metavar="FROM:TO", help="Seconds of neutral standing in the first trial: sets the axes."),
]
People = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Whose markers, where files hold several people's (NAME:LASI)."),
]
Functional = Annotated[
    bool, typer.Option("--functional", help="Joint centres where the motion has them, whatever rules say.")
]
RulesOnly = Annotated[
    bool, typer.Option("--rules-only", help="Joint centres where the rules have them, whatever moves.")
]


@dataclass(frozen=True)
class FitChoice:
    """What the user said about how a body is fitted."""

    person: People = None
    measure: Length = None
    angle: WandAngle = None
    up: Up = None
    neutral: Neutral = None
    functional: Functional = False
    rules_only: RulesOnly = False

    def options(self) -> FitOptions:
        """Return the options of the fit. Raises ``GatewayError`` for texts that mean nothing."""
        from gateway.reconstruction.optical.fitting import FitOptions

        if self.functional and self.rules_only:
            raise GatewayError("--functional and --rules-only contradict each other: leave one out")
        return FitOptions(
            vertical=_axis(self.up),
            lengths=dict(map(_measurement, self.measure or [])),
            angles=dict(map(_angle, self.angle or [])),
            neutral=None if self.neutral is None else seconds_of("--neutral", self.neutral),
            centres="motion" if self.functional else "rules" if self.rules_only else "both",
            person=self.person,
        )


@with_options(FitChoice)
def fit(
    choice: FitChoice,
    files: Annotated[
        list[Path],
        typer.Argument(help="Calibration trials, C3D, TRC, TSV or CSV: a static one first, then motion."),
    ],
    marker_set: Annotated[
        str | None,
        typer.Option(
            "--set", metavar="SET", help="Marker set: a shipped one, or a file; without: the one that fits."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The subject file; default: after the first trial.")
    ] = None,
    force: ReplaceFiles = False,
    as_json: AsJson = False,
) -> None:
    """Fit a body to marker trials: bone lengths, joint centres, where markers sit. Writes a subject file.

    Joint centres come from the marker set's rules (published regressions) and, as far as the trials move the
    joints, from the motion.
    """
    from gateway.reconstruction.optical.fitting import fit_body
    from gateway.reconstruction.optical.marker_set import load_marker_set
    from gateway.reconstruction.optical.worn_markers import fitting_set

    target = output or files[0].with_suffix(".yaml")
    refuse_existing(target, force)
    options = choice.options()
    known = None if marker_set is None else load_marker_set(marker_set)
    trials = _read_trials(files, not as_json)
    chosen = known or fitting_set(trials, choice.person)
    with progress_bar("fitting the body", is_shown=not as_json) as progress:
        found = fit_body(chosen, trials, options, progress)
    outcome = {"file": str(target), "trials": [file.name for file in files], **found.figures()}
    _write_fit(found, outcome, target)
    if as_json:
        typer.echo(json.dumps(outcome, indent=2))
    else:
        _print_fit(found, target, functional=choice.functional)


def _read_trials(files: list[Path], is_shown: bool) -> list[MarkerTrial]:
    from devices.marker_files import read_markers

    with progress_bar("reading", is_shown=is_shown) as progress:
        trials = []
        for done, file in enumerate(files):
            progress(done, len(files))
            trials.append(read_markers(file))
    _print_notes(trials)
    return trials


def _print_notes(trials: Sequence[MarkerTrial]) -> None:
    for trial in trials:
        for note in trial.notes:
            typer.echo(f"note: {note}", err=True)


def _write_fit(found: Fit, outcome: dict[str, object], target: Path) -> None:
    from gateway.body.subject_file import subject_content, write_subject
    from gateway.recording.snapshot import body_of

    measured = found.measured
    content = subject_content(
        target.stem, found.marker_set, body_of(found.skeleton), found.skeleton, found.markers,
        {key: outcome[key] for key in ("trials", "frames", "rmse_mm")}, measured.lengths, measured.angles,
    )  # fmt: skip
    with writing(target):
        write_subject(target, content)


def _axis(text: str | None) -> str | None:
    from gateway.reconstruction.optical.landmarks import AXES_UP

    if text is not None and text not in AXES_UP:
        raise GatewayError(f"--up {text}: one of {', '.join(AXES_UP)} is wanted")
    return text


def _measurement(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        length = float(value)
    except ValueError:
        length = 0.0
    if not 0.001 < length < 2:
        raise GatewayError(f"--measure {text}: NAME=METRES is wanted, such as left_knee_width=0.105")
    return name, length


def _angle(text: str) -> tuple[str, float]:
    from gateway.reconstruction.optical.landmarks import MOST_ANGLE

    name, _, value = text.partition("=")
    try:
        angle = math.radians(float(value))
    except ValueError:
        angle = math.nan
    if not abs(angle) <= MOST_ANGLE:
        raise GatewayError(f"--angle {text}: NAME=DEGREES is wanted, such as left_thigh_rotation=8")
    return name, angle


def _print_fit(found: Fit, target: Path, *, functional: bool) -> None:
    from gateway.reconstruction.optical.fitted_body import fit_notes

    lengths, moved = found.lengths_mm, found.moved_mm
    table = Table(Column("segment", no_wrap=True), "length mm", "joint moved by motion mm", "markers")
    for name in found.skeleton.segment_names:
        table.add_row(name, f"{lengths[name]:.0f}", f"{moved[name]:.0f}", found.worn_on(name) or "–")
    Console().print(table)
    typer.echo(
        f"{target}: {len(found.markers.labels)} markers of {found.marker_set}, {found.frames} frames, "
        f"rest {round(1e3 * found.rmse, 2)} mm RMS, {found.markers.vertical} up"
    )
    for name, angle in found.measured.angles.items():
        if angle:
            typer.echo(f"{name}: {math.degrees(angle):.1f}° (--angle {name}=0 takes the wand as it stands)")
    for note in fit_notes(found, functional=functional):
        typer.echo(f"note: {note}", err=True)


Subject = Annotated[str, typer.Option("--subject", "-s", help="Subject file of `optical fit`.")]
Person = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Whose markers, where the file holds several people's (NAME:LASI)."),
]
Method = Annotated[
    str,
    typer.Option(
        help="default: whole body, frame by frame; both_ways: the same, offline, with gaps bridged from both "
        "sides; published: that of CN1766831A, chain by chain, offline and far slower."
    ),
]


def solve(
    file: Annotated[Path, typer.Argument(help="Trial, C3D, TRC, TSV or CSV.")],
    subject: Subject,
    person: Person = None,
    method: Method = "default",
    up: Annotated[
        str | None, typer.Option(help="Axis of the file that points up, where it is not that of the subject.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The recording; default: after trial and method, .mcap."),
    ] = None,
    to: Annotated[
        list[str] | None, typer.Option(metavar="FORMAT", help=f"Export too: {', '.join(FORMATS)}.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Residuals of all markers over time as a picture (.png, .svg, .pdf).")
    ] = None,
    force: ReplaceFiles = False,
    as_json: AsJson = False,
) -> None:
    """Solve a trial for a fitted subject, into a recording that replays, exports and reports like any
    other."""
    from devices.marker_files import read_markers
    from gateway.recording.optical import write_residual_plot, write_solved_trial

    _check_method(method)
    suit = _subject(subject, up)
    check_formats(to or [])
    suffix = "" if method == "default" else f"_{method}"
    target = output or file.with_name(f"{file.stem}{suffix}.mcap")
    refuse_existing(target, force)
    for name in to or []:
        _check_export(target.with_suffix(FORMATS[name].suffix), file, name, force)
    trial = read_markers(file)
    _print_notes([trial])
    if up is None:
        _note_lying(trial, suit, person)
    target.unlink(missing_ok=True)
    if method == "default":
        make_ready(OPTICAL)
    with progress_bar("solving", is_shown=not as_json) as progress, writing(target):
        done = write_solved_trial(trial, file, suit, subject, target, progress, person, method)
    if plot is not None:
        write_residual_plot(done, trial.rate_hz, plot)
    if as_json:
        typer.echo(json.dumps(done.figures(), indent=2))
    else:
        _print_solved(done)
    if to:
        export(target, to=to, force=force)  # type: ignore[arg-type]  # names of formats, checked above


def _check_export(path: Path, trial: Path, name: str, force: bool) -> None:
    """Raise ``GatewayError`` where an export would replace the trial, or another file without ``force``."""
    if path.resolve() == trial.resolve():
        raise GatewayError(
            f"--to {name} would replace the trial {trial} itself: name the recording, and with it its "
            f"exports, otherwise: -o {trial.stem}_solved.mcap"
        )
    refuse_existing(path, force)


def play(
    file: Annotated[Path, typer.Argument(help="Trial, C3D, TRC, TSV or CSV.")],
    subject: Annotated[
        list[str],
        typer.Option(
            "--subject", "-s", help="Subject file of `optical fit`; once for each person of the file."
        ),
    ],
    person: Person = None,
    method: Method = "default",
    speed: Annotated[str, typer.Option(help="1: as captured, 2: twice as fast, …, max: as it goes.")] = "1",
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Broker, gateway name and outputs from this file.")
    ] = None,
    embedded: Embedded = False,
    as_json: AsJson = False,
) -> None:
    """Play a trial over MQTT like a live optical system: `watch`, `view` and all else see a suit."""
    from devices.links.marker_file_link import MarkerFileLink
    from devices.marker_files import read_markers
    from gateway.service.further_bodies import further_bodies
    from gateway.service.service import Service

    _refuse_unplayable(file, subject, person, method)
    suit = _subject(subject[0])
    pace = speed_of(speed)
    trial = read_markers(file)
    _print_notes([trial])
    assert suit.markers is not None  # _subject sees to it
    for each in subject:
        _refuse_open_names(trial, _subject(each), person)
    make_ready(OPTICAL)
    settings = _played_settings(file, subject, trial.rate_hz, config, embedded=embedded)
    labels = suit.markers.labels if len(subject) == 1 else ()  # of several, each finds its own
    link = MarkerFileLink(file, speed=pace, name="markers", labels=labels, person=person)
    others = further_bodies(settings)
    service = Service(settings, suit, [link], others=others)
    link.hold = Brake(service, is_paced=pace is not None).hold
    names = [settings.gateway, *(other.gateway for other, _ in others)]
    topics = ", ".join(f"{settings.mqtt.base_topic}/{name}/pose" for name in names)
    typer.echo(f"playing to {topics}; Ctrl-C ends", err=True)
    asyncio.run(play_link(service, link, as_json))
    print_outcome(service, as_json)


def _refuse_unplayable(file: Path, subject: Sequence[str], person: str | None, method: str) -> None:
    """Raise ``GatewayError`` for options that do not go together, or a method that cannot stream."""
    _check_method(method)
    if method in OFFLINE:
        raise GatewayError(
            f"--method {method} wants all frames at once and cannot stream: `mocap-gateway optical solve "
            f"{file} --method {method}`, or leave it out"
        )
    if person is not None and len(subject) > 1:
        raise GatewayError("--person goes with one --subject: of several, each has its own markers' names")


def _played_settings(
    file: Path, subject: Sequence[str], rate_hz: float, config: Path | None, *, embedded: bool
) -> GatewaySettings:
    """Return the configuration that a trial is played with: a body for each subject after the first, and what
    ``config`` says of broker, name and outputs."""
    from gateway.recording.optical import optical_settings

    settings = optical_settings(subject[0], rate_hz, f"markers://{file.resolve()}")
    # Markers are where they were seen: so is the body.
    changes: dict[str, object] = {
        "bodies": [BodySettings(name=Path(each).stem, subject=each) for each in subject[1:]],
        "mqtt": settings.mqtt.model_copy(update={"include": frozenset({PoseMap.POSITION})}),
    }
    if config is not None:
        given = load_gateway_settings(config)
        changes |= {
            "mqtt": given.mqtt,
            "gateway": given.gateway,
            "outputs": given.outputs,
            "recording": given.recording,
        }
    return for_playing(settings.model_copy(update=changes), embedded=embedded)


def _check_method(method: str) -> None:
    """Raise ``GatewayError`` for a method that there is not."""
    from gateway.recording.optical import METHODS

    if method not in METHODS:
        raise GatewayError(f"--method {method}: one of {', '.join(METHODS)} is wanted")


def _subject(name: str, up: str | None = None) -> WornSuit:
    from gateway.body.rig import load_rig

    suit = load_rig(name)
    if suit.markers is None:
        raise GatewayError(f"{name} is a rig without markers: --subject wants a file of `optical fit`")
    axis = _axis(up)
    return suit if axis is None else replace(suit, markers=replace(suit.markers, vertical=axis))


def _note_lying(trial: MarkerTrial, suit: WornSuit, person: str | None) -> None:
    """Print a note where the body lies along a horizontal axis of the file throughout."""
    from devices.marker_files.naming import spelt
    from gateway.reconstruction.optical.tracking import upright_axis

    markers = suit.markers
    assert markers is not None  # _subject sees to it
    places = spelt(trial, markers.labels, person=person).columns(markers.labels)
    axis = upright_axis(suit.skeleton, markers, places)
    if axis not in {None, markers.vertical}:
        typer.echo(
            f"note: {trial.name}: the body lies along {axis} of the file, {markers.vertical} points up in "
            f"the subject's trials: if {axis} points up here, solve it with --up {axis}",
            err=True,
        )


def _refuse_open_names(trial: MarkerTrial, suit: WornSuit, person: str | None) -> None:
    """Raise ``FormatError`` where it is open whose markers of a trial are a subject's."""
    from devices.marker_files.naming import spelt

    assert suit.markers is not None  # _subject sees to it
    spelt(trial, suit.markers.labels, person=person)


def _print_solved(done: SolvedTrial) -> None:
    table = Table("marker", "rest mm", "seen %", "used %")
    for label, figures in done.markers().items():
        rest = "–" if figures["rmse_mm"] is None else f"{figures['rmse_mm']:.1f}"
        table.add_row(label, rest, f"{figures['seen_percent']:.0f}", f"{figures['used_percent']:.0f}")
    Console().print(table)
    typer.echo(
        f"{done.path}: {done.frames} frames, rest {round(1e3 * done.rmse, 2)} mm RMS, "
        f"{done.ms_per_frame:.2f} ms a frame; {len(done.renamed)} names put right, "
        f"{done.counts.get('rejected', 0)} points left out"
    )
    if done.is_poor:
        typer.echo(
            f"note: {100 * done.share_used:.0f} % of the points seen had a say, rest "
            f"{1e3 * done.rmse:.0f} mm: is this the subject's own trial, in the unit that the file tells? If "
            "not, `optical fit` it first",
            err=True,
        )


def serve(
    file: Annotated[Path, typer.Argument(help="Trial, C3D, TRC, TSV or CSV.")],
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to serve on; 0: any that is free.")
    ] = DEFAULT_PORT,
    host: Annotated[str, typer.Option(help="Address to serve on.")] = "127.0.0.1",
    up: Annotated[str, typer.Option(help="Axis of the file that points up: x, y or z.")] = "z",
    speed: Annotated[float, typer.Option(min=0.01, max=100, help="1: as captured.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="Stop at the end; else begin anew.")] = False,
) -> None:
    """Stand in for a Qualisys QTM: serve a trial by its real-time protocol, to try a set-up without cameras.

    Whoever connects sees it from the beginning on: a gateway with a link `url: qtm://127.0.0.1:22223`.
    Written from the published protocol; no QTM was at hand.
    """
    from devices.marker_files import read_markers

    if up not in {"x", "y", "z"}:
        raise GatewayError(f"--up {up}: x, y or z is wanted")
    asyncio.run(_serve(read_markers(file), file, port, host, up, speed, once))


async def _serve(
    trial: MarkerTrial, file: Path, port: int, host: str, up: str, speed: float, once: bool
) -> None:
    from devices.emulators.qtm_stand_in import QtmStandIn

    ended = asyncio.Event()
    stand_in = QtmStandIn(trial, up=f"+{up.upper()}", speed=speed, repeats=not once, on_end=ended.set)
    try:
        await stand_in.start(host, port)
    except OSError as error:
        raise GatewayError(f"{host}:{port} cannot be served: {error.strerror or error}") from error
    typer.echo(
        f"{file}: {trial.n_frames} frames at {trial.rate_hz:g} Hz as QTM streams them; "
        f"a gateway receives them with the link qtm://{host}:{stand_in.port}; Ctrl-C ends",
        err=True,
    )
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    await ended.wait()
    await stand_in.stop()
    typer.echo(f"{stand_in.sent} frames sent")


optical_app = typer.Typer(
    help="Markers of an optical system (C3D, TRC, live): fit a body, solve, play.",
    epilog="Examples: mocap-gateway optical fit static.c3d walk.c3d -o anna.yaml; "
    "mocap-gateway optical solve walk.c3d --subject anna.yaml",
    no_args_is_help=True,
)
optical_app.command(
    epilog="Examples: mocap-gateway optical fit static.c3d walk1.c3d -o anna.yaml; "
    "mocap-gateway optical fit static.trc walk.trc --set opensim_41 --measure left_knee_width=0.105"
)(fit)
optical_app.command(
    epilog="Examples: mocap-gateway optical solve walk.c3d --subject anna.yaml --to bvh; "
    "mocap-gateway optical solve walk.c3d --subject anna.yaml --plot residuals.png; "
    "mocap-gateway optical solve walk.c3d --subject anna.yaml --method published -o walk_published.mcap"
)(solve)
optical_app.command(
    epilog="Example: mocap-gateway optical play walk.c3d --subject anna.yaml --embedded --speed 0.5"
)(play)
optical_app.command(epilog="Example: mocap-gateway optical serve walk.c3d --port 22223")(serve)
