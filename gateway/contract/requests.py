"""What may be asked of a gateway, ``bridge/request/<family>/<verb>``, and with which data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from firmware_protocol import MAX_MODULE
from gateway.errors import GatewayError, nearest
from gateway.support.former_names import current
from gateway.support.names import KEPT_FILE, RECORDING_NAME, SETTING_PLACE, UNIQUE_ID
from gateway.support.settings_files import explained


class Request(BaseModel):
    """The data of a request: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class InfoRequest(Request):
    """What the gateway is and runs: as on ``bridge/info``."""


class HealthRequest(Request):
    """Its counters, now: as on ``bridge/health``."""


class ReloadRequest(Request):
    """Read the configuration anew. A wrong one is told, and the old one stays."""


class ExamineRequest(Request):
    """What `mocap-gateway doctor` finds of the running gateway, and which ports its computer has."""


class ConnectRequest(Request):
    """Have a link that is not up use another port of the gateway's computer: its url changes in the
    configuration file, which is read anew."""

    link: str = Field(min_length=1, max_length=40, description="name of a link of the configuration")
    port: str = Field(
        min_length=1, max_length=200, description="a port as `gateway/examine` names it: /dev/ttyUSB0, can0"
    )


class ConfigureRequest(Request):
    """Show what other settings would change, or take them into use until `gateway/confirm`: without that the
    gateway goes back by itself. Only sections that its configuration allows (`allow_configuration`)."""

    settings: dict[Annotated[str, Field(pattern=SETTING_PLACE)], JsonValue] = Field(
        min_length=1,
        max_length=32,
        description="value by name, such as recording.rotate_minutes; null: as the gateway's own file says",
    )
    dry_run: bool = Field(default=True, description="only show the differences")
    confirm_within_s: float = Field(
        default=60, ge=5, le=600, description="after so long without `gateway/confirm` all is as before, s"
    )


class ConfirmRequest(Request):
    """Keep the settings that were taken into use last."""

    token: str = Field(max_length=64, description="as `gateway/configure` told it")


GATEWAY_REQUESTS: dict[str, type[Request]] = {
    "info": InfoRequest,
    "health": HealthRequest,
    "reload": ReloadRequest,
    "examine": ExamineRequest,
    "connect": ConnectRequest,
    "configure": ConfigureRequest,
    "confirm": ConfirmRequest,
}
"""Verb to the data it takes."""


DeviceName = Annotated[
    str,
    Field(min_length=1, max_length=24, description="module id, 'relay', or the beginning of a unique id"),
]
UniqueId = Annotated[str, Field(pattern=UNIQUE_ID, description="12 bytes, hexadecimal")]
ModuleId = Annotated[int, Field(ge=0, le=MAX_MODULE)]
SettingName = Annotated[str, Field(max_length=40)]

LARGEST_READ = 8 * 1024
"""Most bytes of a card file in one answer."""


class ListRequest(Request):
    """Who is there, and how each fares."""

    listen_s: float = Field(
        default=2.0, ge=0.5, le=30, description="how long rates and losses are measured, s"
    )


class IdentifyRequest(Request):
    """Make a device blink."""

    device: DeviceName
    seconds: int = Field(default=5, ge=0, le=255, description="0 stops it")


class ReadRequest(Request):
    """All settings of a device."""

    device: DeviceName


class SetRequest(Request):
    """Change settings of a device."""

    device: DeviceName
    settings: dict[SettingName, JsonValue] = Field(min_length=1, max_length=32)


class AssignRequest(Request):
    """Give devices module ids."""

    ids: dict[UniqueId, ModuleId] = Field(min_length=1, max_length=64)


class SeparateRequest(Request):
    """Give all but one of the devices that share a module id a free one."""


class UndoRequest(Request):
    """Write back what stood there before the last change."""


class MotionRequest(Request):
    """Which module is shaken or tapped."""

    seconds: float = Field(default=20.0, ge=0.5, le=120, description="how long to wait for it")
    continues: bool = Field(default=False, description="what has moved since the last request counts too")


class BackupRequest(Request):
    """All settings of all modules."""


class RestoreRequest(Request):
    """Write a backup back."""

    modules: dict[UniqueId, dict[SettingName, JsonValue]] = Field(max_length=64)


class CardListRequest(Request):
    """The files on a memory card."""

    device: DeviceName = "relay"


class CardStartRequest(Request):
    """Begin to record on a card, in a new file."""

    device: DeviceName = "relay"


class CardStopRequest(Request):
    """End the recording on a card."""

    device: DeviceName = "relay"


class CardReadRequest(Request):
    """A piece of a file on a memory card."""

    device: DeviceName = "relay"
    file: int = Field(ge=0, lt=0xFFFF)
    offset: int = Field(ge=0, lt=2**32)
    length: int = Field(ge=1, le=LARGEST_READ)


class CardEraseRequest(Request):
    """Erase files of a memory card."""

    device: DeviceName = "relay"
    file: int | None = Field(default=None, ge=0, lt=0xFFFF, description="none: all of them")


MODULE_REQUESTS: dict[str, type[Request]] = {
    "list": ListRequest,
    "identify": IdentifyRequest,
    "read": ReadRequest,
    "set": SetRequest,
    "assign": AssignRequest,
    "separate": SeparateRequest,
    "undo": UndoRequest,
    "motion": MotionRequest,
    "backup": BackupRequest,
    "restore": RestoreRequest,
    "card_list": CardListRequest,
    "card_start": CardStartRequest,
    "card_stop": CardStopRequest,
    "card_read": CardReadRequest,
    "card_erase": CardEraseRequest,
}
"""Verb to the data it takes."""


class StartRecordingRequest(Request):
    """Begin to record."""

    name: str | None = Field(
        default=None,
        pattern=RECORDING_NAME,
        description="added to the file's name, which begins with the time",
    )


class StopRecordingRequest(Request):
    """End the recording."""


class RecordingStatusRequest(Request):
    """Whether and where is being recorded, and how it goes."""


FileName = Annotated[
    str,
    Field(pattern=KEPT_FILE, description="name of a file in the folder of the recordings"),
]

LARGEST_PIECE = 128 * 1024
"""Most bytes of a recording in one answer."""


class ListRecordingsRequest(Request):
    """The recordings, newest first: begun, how long, size, loss, what the body did half-way."""

    most: int = Field(default=20, ge=1, le=100, description="only so many")


class ExportRecordingRequest(Request):
    """Write the poses of a recording in a format of other programs, into the same folder."""

    file: FileName
    to: str = Field(max_length=20, description="one of the formats that `recording/list` told")


class ReadRecordingRequest(Request):
    """A piece of a recording, or of what was exported."""

    file: FileName
    offset: int = Field(ge=0, lt=2**63)
    length: int = Field(default=LARGEST_PIECE, ge=1, le=LARGEST_PIECE)


class MarkRequest(Request):
    """Mark this instant: an event in the recording under way."""

    text: str = Field(default="", max_length=200, description="what is to be found again")


RECORDING_REQUESTS: dict[str, type[Request]] = {
    "start": StartRecordingRequest,
    "stop": StopRecordingRequest,
    "status": RecordingStatusRequest,
    "mark": MarkRequest,
    "list": ListRecordingsRequest,
    "export": ExportRecordingRequest,
    "read": ReadRecordingRequest,
}
"""Verb to the data it takes."""


SegmentName = Annotated[str, Field(max_length=40)]


class BeginCalibrationRequest(Request):
    """Begin a body calibration; one under way is given up. Answers with the steps to do."""

    field: bool = Field(default=True, description="magnetometers tell headings; false: only the movements do")


class CalibrationStepRequest(Request):
    """Do a step: counts down, then records. Answers at once; `calibration/status` says how far it is."""

    step: str = Field(max_length=40, description="one of the steps that `calibration/begin` told")
    countdown_s: float = Field(default=3.0, ge=0, le=30, description="time to get ready, s")
    seconds: float | None = Field(default=None, ge=1, le=120, description="how long; none: as planned")
    segments: list[SegmentName] | None = Field(
        default=None, max_length=64, description="only these are done again; none: all"
    )


class CalibrationStatusRequest(Request):
    """How far it is, and what every module does at the moment."""


class CalibrationResultRequest(Request):
    """What the steps done so far give: a score for each module, and why when it is not good."""


class AcceptCalibrationRequest(Request):
    """Use the result from now on, and keep it in a rig file where one is named."""

    segments: list[SegmentName] | None = Field(
        default=None, max_length=64, description="only these; none: all that are not poor"
    )
    poor: bool = Field(default=False, description="take poor results too")
    save: bool = Field(
        default=False,
        description="write the configuration's rig file too; of a shipped one `<rig>.worn.yaml`, which the "
        "configuration names from then on",
    )


class CancelCalibrationRequest(Request):
    """Give it up; nothing changes."""


class CalibrationHistoryRequest(Request):
    """Earlier versions of the rig file that `accept` writes."""


class RestoreCalibrationRequest(Request):
    """Put an earlier version of the rig file back, and wear the suit by it."""

    version: str | None = Field(default=None, max_length=40, description="as listed; none: the newest")


class MeasureRequest(Request):
    """Tell the wearer's measures; with any, keep them in the rig file first, and wear the body of them."""

    height_m: float | None = Field(default=None, gt=0.4, lt=2.6, description="stature, m; none: as it is")
    mass_kg: float | None = Field(default=None, gt=2, lt=400, description="body mass, kg; none: as it is")
    lengths: dict[SegmentName, Annotated[float, Field(gt=0.005, lt=2.0)] | None] = Field(
        default={},
        max_length=64,
        description="measured, m, from joint to joint: `thigh` (both), `left_thigh`, `hip_width`; null: "
        "forgotten",
    )


CALIBRATION_REQUESTS: dict[str, type[Request]] = {
    "measure": MeasureRequest,
    "begin": BeginCalibrationRequest,
    "step": CalibrationStepRequest,
    "status": CalibrationStatusRequest,
    "result": CalibrationResultRequest,
    "accept": AcceptCalibrationRequest,
    "cancel": CancelCalibrationRequest,
    "history": CalibrationHistoryRequest,
    "restore": RestoreCalibrationRequest,
}
"""Verb to the data it takes."""


class BeginSensorsRequest(Request):
    """Begin to watch what modules in a box measure; one under way is given up."""

    sensors: list[Literal["gyroscope", "accelerometer", "magnetometer"]] | None = Field(
        default=None, min_length=1, description="only these; none: all"
    )
    modules: list[ModuleId] | None = Field(
        default=None, min_length=1, max_length=64, description="only these; none: all of the rig"
    )
    cube: bool = Field(default=False, description="they lie on the six sides of a levelled cube")


class SensorsStatusRequest(Request):
    """What to do next, and how far every module is."""


class SensorsResultRequest(Request):
    """End watching; what was found by module and sensor: biases, scales, quality, and why when it is poor."""


class AcceptSensorsRequest(Request):
    """Keep the result, in a rig file or in the modules."""

    flash: bool = Field(
        default=False,
        description="write to the modules, which `allow_device_writes` must allow; else to the rig file of "
        "the configuration, of a shipped one to `<rig>.worn.yaml`: used once the configuration is read anew",
    )
    poor: bool = Field(default=False, description="take poor results too")


class CancelSensorsRequest(Request):
    """Give it up; nothing changes."""


SENSOR_REQUESTS: dict[str, type[Request]] = {
    "begin": BeginSensorsRequest,
    "status": SensorsStatusRequest,
    "result": SensorsResultRequest,
    "accept": AcceptSensorsRequest,
    "cancel": CancelSensorsRequest,
}
"""Verb to the data it takes."""


class HeadingResetRequest(Request):
    """Turn the world so that the wearer faces a direction."""

    facing_deg: float = Field(
        default=0.0, ge=-360, le=360, description="heading afterwards, anticlockwise from east"
    )


class FullResetRequest(Request):
    """Heading and mounting at once: stand in the N-pose."""

    facing_deg: float = Field(
        default=0.0, ge=-360, le=360, description="heading afterwards, anticlockwise from east"
    )


class MountingResetRequest(Request):
    """Take every segment to be in the neutral posture now: stand in the N-pose."""


class PositionResetRequest(Request):
    """Bring the body to the world's origin, where it stands; it faces as before, and its height stays."""


RESET_REQUESTS: dict[str, type[Request]] = {
    "heading": HeadingResetRequest,
    "full": FullResetRequest,
    "mounting": MountingResetRequest,
    "position": PositionResetRequest,
}


REQUEST_FAMILIES: Mapping[str, Mapping[str, type[Request]]] = {
    "gateway": GATEWAY_REQUESTS,
    "modules": MODULE_REQUESTS,
    "recording": RECORDING_REQUESTS,
    "calibration": CALIBRATION_REQUESTS,
    "sensors": SENSOR_REQUESTS,
    "reset": RESET_REQUESTS,
}


def asked(family: str, verb: str, data: Mapping[str, Any]) -> Request:
    """Return a request, read. Raises ``GatewayError`` that names the unknown verb, or the wrong field."""
    verbs = REQUEST_FAMILIES[family]
    if verb not in verbs:
        raise GatewayError(f"there is no request '{family}/{verb}'{nearest(verb, verbs)}")
    try:
        # Former names are replaced first, as the models know today's alone.
        return verbs[verb].model_validate(current(dict(data)))
    except ValidationError as error:
        raise GatewayError(f"{family}/{verb}: {explained(error.errors()[0], verbs[verb])}") from error
