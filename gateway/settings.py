"""The gateway's configuration: one YAML file, checked before anything is opened."""

from __future__ import annotations

import functools
import operator
from collections.abc import Set
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    field_validator,
    model_validator,
)

from devices.link import SUIT
from devices.recording_format import SUFFIX as RECORDING_SUFFIX
from gateway.errors import SettingsError, nearest
from gateway.outputs.settings import MqttSettings, OutputsSettings
from gateway.reconstruction import (
    NO_CONTACTS,
    OFFLINE,
    OPTICAL,
    RECONSTRUCTORS,
    RootMode,
    RootSettings,
    refuse_delay,
    refuse_unknown,
    refuse_unreadable,
)
from gateway.sources.clock_mode import ClockMode
from gateway.sources.link_settings import LinkSettings, has_credentials
from gateway.sources.makers import OthersLinkSettings
from gateway.sources.registry import SOURCES, refuse_unsuited
from gateway.support.credentials import AccessToken, token_for
from gateway.support.log_format import LogFormat
from gateway.support.names import PLAIN_NAME, RECORDING_NAME
from gateway.support.settings_files import Strict, load_settings, load_yaml

METRICS_TOKEN_VARIABLE = "MOCAP_METRICS_TOKEN"
"""Environment variable that may hold the token of metrics and health."""

MAX_DELAY_MS = 2000.0


def _settings_class(given: Any) -> str:
    """Name the class of a link's settings, by what it carries."""
    carries = given.get("carries") if isinstance(given, dict) else getattr(given, "carries", None)
    return SOURCES.get(str(carries), SOURCES[SUIT]).settings.__name__


def _is_carried(given: Any) -> Any:
    """Refuse a link that carries what nothing reads, or has settings of links that carry something else.

    This comes first, since ``carries`` says which settings there are.
    """
    fields = given.model_dump() if isinstance(given, LinkSettings) else given
    if not isinstance(fields, dict) or has_credentials(fields.get("url")):  # refused without being shown
        return given
    carries = str(fields.get("carries", SUIT))
    if carries not in SOURCES:
        raise ValueError(f"carries: no source reads '{carries}'{nearest(carries, SOURCES)}")
    foreign = fields.keys() - _fields(carries)
    others = [each for each in SOURCES if foreign and foreign <= _fields(each)]
    if others:
        what = ", ".join(sorted(foreign))
        raise ValueError(f"'{what}' goes with carries: {', '.join(others)}; this link carries {carries}")
    return fields if type(given) is LinkSettings else given


def _fields(carries: str) -> Set[str]:
    return SOURCES[carries].settings.model_fields.keys()


if TYPE_CHECKING:
    from gateway.body.skeleton import WornSuit
    from gateway.stages.frame_assembler import AssemblyParams

    AnyLinkSettings = LinkSettings
else:
    _kinds = dict.fromkeys(source.settings for source in SOURCES.values())
    _tagged = [Annotated[kind, Tag(kind.__name__)] for kind in _kinds]
    AnyLinkSettings = Annotated[
        functools.reduce(operator.or_, _tagged),
        Discriminator(_settings_class),
        BeforeValidator(_is_carried),
    ]
"""Those of the source that reads what the link carries."""


class ClockSettings(Strict):
    """How module time becomes gateway time."""

    mode: ClockMode = Field(
        default=ClockMode.ESTIMATED,
        description="estimated: every module has its own crystal; shared: they count one clock already; "
        "synchronised: they keep their clocks together by themselves, as x-IMU3 in one network do; "
        "table: rates as measured by `calibrate clocks`; trigger: the gateway tells modules when to sample "
        "(they must be set to it: mode 3)",
    )
    table: str | None = Field(
        default=None,
        description="for mode table: file that `calibrate clocks` wrote; a path, or beside this file",
    )

    sync_rate_hz: float = Field(
        default=4,
        ge=0,
        le=50,
        description="for modes estimated and trigger: how often all modules are asked for their time, which "
        "takes the transport's delay out of the clocks of those that answer; 0: never",
    )
    trigger_rate_hz: float = Field(
        default=100,
        ge=1,
        le=1000,
        description="for mode trigger: how often all modules are told to sample",
    )
    trigger_patience_ms: float = Field(
        default=250,
        gt=0,
        le=10_000,
        description="for mode trigger: how long an answer is waited for; one that comes later is dropped "
        "and counts as missed",
    )

    @model_validator(mode="after")
    def _has_table(self) -> ClockSettings:
        if (self.mode is ClockMode.TABLE) != (self.table is not None):
            raise ValueError(
                "mode 'table' needs 'table: <file>' (see `calibrate clocks`), and no other mode does"
            )
        return self


class AssemblySettings(Strict):
    """How samples of many modules become frames of one instant."""

    rate_hz: float = Field(default=100, ge=0.1, le=4000, description="skeleton frames a second")
    max_wait_ms: float = Field(
        default=30, ge=0, le=10_000, description="latency budget: how long a frame waits for late samples"
    )
    max_gap_ms: float = Field(
        default=100, ge=0, le=10_000, description="longest gap bridged by interpolation"
    )
    hold_ms: float = Field(
        default=500, ge=0, le=60_000, description="how long a silent module's last value stands"
    )
    despike: bool = Field(
        default=False, description="take single wild values out of raw samples; costs one sample of delay"
    )

    def params(self) -> AssemblyParams:
        """Return the settings in the units of the assembler, ns."""
        from gateway.stages.frame_assembler import AssemblyParams  # noqa: PLC0415 - needs kernels

        return AssemblyParams(
            frame_interval_ns=1e9 / self.rate_hz,
            max_wait_ns=round(self.max_wait_ms * 1e6),
            max_gap_ns=round(self.max_gap_ms * 1e6),
            hold_ns=round(self.hold_ms * 1e6),
        )


class RootMotionSettings(Strict):
    """Whether the body moves through the world."""

    mode: RootMode = Field(
        default=RootMode.AUTO,
        description="walking: the body stands on resting feet, flies between them and so moves through the "
        "world; fixed: its root stays at the origin, or where a local device measures it; auto: walking for "
        "bodies with contacts (feet) whose position no device measures",
    )
    floor: Literal["level", "open"] = Field(
        default="level",
        description="level: feet stand on one level floor, so that height does not drift; "
        "open: heights as they are found (stairs, slopes)",
    )
    floor_height_m: float = Field(default=0, ge=-1000, le=1000, description="height of a level floor")

    def root(self) -> RootSettings:
        """Return the settings as the reconstructors take them."""
        return RootSettings(self.mode, self.floor == "level", self.floor_height_m)


class ModuleReportSettings(Strict):
    """What is published of every module."""

    state_interval_s: float = Field(
        default=2, ge=0.5, le=3600, description="most often that one module's state is published, s"
    )
    silent_after_s: float = Field(
        default=3, ge=0.5, le=3600, description="a module counts as offline after so long without a packet, s"
    )


class MetricsSettings(Strict):
    """Prometheus metrics and a health check over HTTP."""

    port: int | None = Field(
        default=None, ge=0, le=65535, description="port of /metrics and /healthz; none: off; 0: any free one"
    )
    host: str = Field(
        default="127.0.0.1",
        min_length=1,
        description="address to listen at: loopback, unless others are to read them (0.0.0.0: all), who then "
        "need a token",
    )
    token_file: Path | None = Field(
        default=None,
        description="file whose first line is the token that readers must show (Authorization: Bearer …); "
        f"without it the environment variable {METRICS_TOKEN_VARIABLE} is taken",
    )

    def token(self) -> AccessToken | None:
        """Return what readers must show. Raises ``CredentialError`` where others could read and need none."""
        return token_for(
            "the metrics", self.host, self.token_file, METRICS_TOKEN_VARIABLE, "metrics.token_file"
        )


class RecordingSettings(Strict):
    """What is kept of a capture, and where."""

    at_start: bool = Field(
        default=False, description="record from the start of the service; else when asked to"
    )
    when_cut_off: bool = Field(
        default=False,
        description="record for as long as no MQTT broker takes poses, where nothing is recorded already",
    )
    folder: str = Field(default="recordings", min_length=1, description="where the files go; made if absent")
    name: str | None = Field(
        default=None,
        pattern=RECORDING_NAME,
        description="added to the file's name, which begins with the time in UTC",
    )
    skeleton: bool = Field(
        default=True,
        description="record skeleton frames too; without them files are about a quarter as large",
    )
    transforms: bool = Field(
        default=True,
        description="with skeleton frames, record them as transforms too: Foxglove and Rerun show the body; "
        "without them files are about a sixth smaller",
    )
    flush_ms: float = Field(
        default=200,
        ge=10,
        le=60_000,
        description="data this old is with the system: most that a kill can cost",
    )
    fsync_s: float = Field(
        default=5,
        ge=0,
        le=3600,
        description="data this old is on the disk, for power cuts; 0: only at the end",
    )
    rotate_mb: float = Field(
        default=2000, ge=0, description="a new file beyond this size, at least 1; 0: never"
    )
    rotate_minutes: float = Field(
        default=60, ge=0, description="a new file after this time, at least 1; 0: never"
    )
    warn_free_mb: float = Field(default=2000, ge=0, description="warn when the disk has less room")
    min_free_mb: float = Field(
        default=500, ge=0, description="stop recording when it has less; the live stream goes on"
    )


class BodySettings(Strict):
    """One more person whose markers come by the same links."""

    name: str = Field(
        pattern=PLAIN_NAME,
        description="poses are published as those of the gateway <gateway>_<name>, and recorded by that name",
    )
    subject: str = Field(min_length=1, description="file of `optical fit`")
    person: str | None = Field(
        default=None, min_length=1, description="whose markers, as 'person' of a link of markers"
    )


class LogSettings(Strict):
    """Logging."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    format: LogFormat = Field(
        default="auto", description="human, json (an object a line), or auto: human on a terminal, else json"
    )


PushedSection = Literal[
    "assembly",
    "log",
    "modules",
    "reconstructor",
    "reconstructor_delay_ms",
    "recording",
    "root_motion",
]
"""What others may be allowed to change: nothing by which data go elsewhere, or a gateway is out of reach."""


class GatewaySettings(Strict):
    """Everything."""

    gateway: str = Field(
        default="gateway1", pattern=PLAIN_NAME, description="name in topics: mocap/<gateway>/…"
    )
    links: list[AnyLinkSettings] = Field(min_length=1, description="where bytes come from")
    rig: str = Field(description="which module sits where: name of a shipped rig, or path of a rig file")
    bodies: list[BodySettings] = Field(
        default=[],
        description="further people whose markers come by the links of markers, each solved, published and "
        "recorded by itself; outputs beside MQTT have the first person alone",
    )
    people: int | None = Field(
        default=None,
        ge=1,
        le=8,
        description="before cameras (`video serve-camera --people`): as many people as are followed at once; "
        "whoever enters is measured, published and recorded as <gateway>_<number> until they have left. Of "
        "the rig the cameras count. None: the one person of the rig",
    )
    reconstructor: str = Field(
        default="joint",
        description=f"one of: {', '.join(sorted(RECONSTRUCTORS))}; or {OPTICAL}, of markers, which is the "
        "default where the rig is a fitted subject",
    )
    reconstructor_delay_ms: float = Field(
        default=0,
        ge=0,
        le=MAX_DELAY_MS,
        description="how much later poses come, corrected by what was seen meanwhile; for gyro_free, which a "
        "tenth of a second makes much better; 0: at once",
    )
    root_motion: RootMotionSettings = RootMotionSettings()
    clock: ClockSettings = ClockSettings()
    assembly: AssemblySettings = AssemblySettings()
    mqtt: MqttSettings = MqttSettings()
    outputs: OutputsSettings = OutputsSettings()
    recording: RecordingSettings = RecordingSettings()
    modules: ModuleReportSettings = ModuleReportSettings()
    metrics: MetricsSettings = MetricsSettings()
    log: LogSettings = LogSettings()
    allow_device_writes: bool = Field(
        default=False,
        description="whether requests may change modules (ids, settings, files on the card): whoever can "
        "publish to the broker could then ask for it",
    )
    allow_configuration: tuple[PushedSection, ...] = Field(
        default=(),
        description="settings that requests may change, with all within them (`fleet configure`); they lie "
        "in a file beside this one, which stays as it is; never recording.folder",
    )

    @model_validator(mode="before")
    @classmethod
    def _sections_may_be_empty(cls, given: Any) -> Any:
        """Take a section in which every line is commented out for one that is left out."""
        if not isinstance(given, dict):
            return given
        optional = {name for name, field in cls.model_fields.items() if not field.is_required()}
        return {name: value for name, value in given.items() if value is not None or name not in optional}

    @field_validator("reconstructor")
    @classmethod
    def _is_known(cls, value: str) -> str:
        if value in OFFLINE:
            raise ValueError(
                f"{value} wants all frames at once: `mocap-gateway optical solve --method {value}`; "
                f"of a stream, {OPTICAL}"
            )
        refuse_unknown(value, OPTICAL)
        return value

    @model_validator(mode="after")
    def _can_be_late(self) -> GatewaySettings:
        try:
            refuse_delay(self.reconstructor, self.reconstructor_delay_ms)
        except ValueError as error:
            raise ValueError(f"reconstructor_delay_ms: {error}") from None
        return self

    @field_validator("links")
    @classmethod
    def _names_differ(cls, value: list[LinkSettings]) -> list[LinkSettings]:
        names = [link.name for link in value]
        if len(set(names)) < len(names):
            raise ValueError("every link needs a name of its own")
        return value

    @model_validator(mode="after")
    def _bodies_have_markers(self) -> GatewaySettings:
        names = [body.name for body in self.bodies]
        if len(set(names)) < len(names):
            raise ValueError("bodies: every one needs a name of its own")
        if self.people is not None and not any(link.carries == "heat_maps" for link in self.links):
            raise ValueError("people: no link carries heat_maps, of which theirs would be")
        if self.bodies and not any(link.carries == "markers" for link in self.links):
            raise ValueError("bodies: no link carries markers, of which theirs would be")
        return self

    @field_validator("links")
    @classmethod
    def _modules_differ(cls, value: list[LinkSettings]) -> list[LinkSettings]:
        """Refuse two devices of one number; modules of our own bear theirs, so that nothing is known yet."""
        known: dict[int, str] = {}
        for link in value:
            for module in link.own_numbers if isinstance(link, OthersLinkSettings) else ():
                if module in known:
                    raise ValueError(
                        f"'{known[module]}' and '{link.name}' both have module {module}: every device "
                        "needs a number of its own"
                    )
                known[module] = link.name
        return value

    def solved_by(self, reconstructor: str | None, delay_ms: float | None = None) -> GatewaySettings:
        """Return the settings with another method, or another delay of it (None: as here).

        Another method gives its frames at once unless a delay is named. Raises ``SettingsError`` for an
        unknown method, and for a delay that it cannot have.
        """
        name = reconstructor or self.reconstructor
        if delay_ms is None:
            delay_ms = self.reconstructor_delay_ms if name == self.reconstructor else 0.0
        if reconstructor is not None:
            check_method(reconstructor)
        try:
            refuse_delay(name, delay_ms)
        except ValueError as error:
            raise SettingsError(str(error)) from None
        return self.model_copy(update={"reconstructor": name, "reconstructor_delay_ms": delay_ms})


def check_method(name: str, option: str = "--reconstructor") -> None:
    """Raise ``SettingsError`` for a method that there is not, asked for on the command line by an option."""
    try:
        refuse_unknown(name)
    except ValueError as error:
        raise SettingsError(f"{option} {name}: {error}") from None


def fitting_suit(settings: GatewaySettings, suit: WornSuit) -> GatewaySettings:
    """Return the settings, with the optical method where a fitted subject wears markers and no modules.

    Raises ``SettingsError`` where another method is named for it (they all want modules), where the suit has
    a sensor that the method cannot use, and for a body that cannot walk and shall.
    """
    if settings.root_motion.mode is RootMode.WALKING and not suit.skeleton.contacts:
        raise SettingsError(f"root_motion.mode: walking: {NO_CONTACTS.format(suit.skeleton.name)}")
    refuse_unreadable(settings.reconstructor, suit)
    for link in settings.links:
        refuse_unsuited(link.name, link.carries, suit)
    if suit.markers is None or suit.module_ids or settings.reconstructor == OPTICAL:
        return settings
    if "reconstructor" in settings.model_fields_set:
        raise SettingsError(
            f"reconstructor '{settings.reconstructor}' wants modules, and '{settings.rig}' is a subject with "
            f"markers only: write 'reconstructor: {OPTICAL}', or leave it out"
        )
    return settings.model_copy(update={"reconstructor": OPTICAL})


def pushed_file(config: Path) -> Path:
    """Return where settings lie that the fleet has pushed: ``gateway.fleet.yaml`` for ``gateway.yaml``."""
    return config.with_suffix(".fleet.yaml")


def pushed_settings(config: Path) -> dict[str, Any]:
    """Return what the fleet has pushed. Raises ``SettingsError`` for a file that cannot be read."""
    file = pushed_file(config)
    loaded = load_yaml(file) if file.exists() else None
    if loaded is not None and not isinstance(loaded, dict):
        raise SettingsError(f"{file}: holds no named settings: delete it to go back to {config.name}")
    return loaded or {}


def load_gateway_settings(path: Path, pushed: dict[str, Any] | None = None) -> GatewaySettings:
    """Return the configuration file. Raises ``SettingsError`` with one line for each thing wrong.

    A clock table named in it may lie beside it. pushed: what the fleet has set, of the sections that the file
    allows; None: as it lies beside the file.
    """
    settings = load_settings(path, GatewaySettings)
    if settings.allow_configuration:
        pushed = pushed_settings(path) if pushed is None else pushed
        allowed: dict[str, Any] = {
            name: value for name, value in pushed.items() if name in settings.allow_configuration
        }
        if allowed:
            settings = load_settings(path, GatewaySettings, allowed)
    _refuse_shared_ports(path, settings.links)
    _refuse_tiny_parts(path, settings.recording)
    if settings.clock.table is not None and (path.parent / settings.clock.table).is_file():
        clock = settings.clock.model_copy(update={"table": str(path.parent / settings.clock.table)})
        settings = settings.model_copy(update={"clock": clock})
    return settings


def _refuse_tiny_parts(path: Path, recording: RecordingSettings) -> None:
    """Refuse a new file at every look; a recording's copy of a configuration may have it, and is read."""
    for name in ("rotate_mb", "rotate_minutes"):
        if 0 < (value := getattr(recording, name)) < 1:
            raise SettingsError(
                f"{path}: 'recording.{name}' is {value:g}: at least 1 is wanted, or 0 for never"
            )


_FOR_ONE_LINK = ("/", "slcan://", "rfc2217://", "udp://")
"""How addresses of ports begin that cannot be opened twice; several links may share a bus or a recording."""


def _refuse_shared_ports(path: Path, links: list[AnyLinkSettings]) -> None:
    """Refuse two links on a port that one alone can open, which the second one would wait for in vain.

    Of a recording's copy of a configuration nothing is opened, so nothing is refused there.
    """
    holders: dict[str, str] = {}
    for link in links:
        address = link.url.partition("?")[0].removeprefix("serial://")
        if not address.startswith(_FOR_ONE_LINK) or address.endswith((RECORDING_SUFFIX, ":0")):
            continue
        if (holder := holders.setdefault(address, link.name)) != link.name:
            raise SettingsError(
                f"{path}: 'links': '{holder}' and '{link.name}' name the same port, which one link alone can "
                "open: give one of them another url"
            )
