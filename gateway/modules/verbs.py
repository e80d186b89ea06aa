"""What may be asked about modules, and with which data."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from firmware_protocol import MAX_MODULE

DeviceName = Annotated[
    str,
    Field(min_length=1, max_length=24, description="module id, 'relay', or the beginning of a unique id"),
]
UniqueId = Annotated[str, Field(pattern=r"^[0-9a-f]{24}$", description="12 bytes, hexadecimal")]
ModuleId = Annotated[int, Field(ge=0, le=MAX_MODULE)]
SettingName = Annotated[str, Field(max_length=40)]

LARGEST_READ = 8 * 1024
"""Most bytes of a card file in one answer."""


class Request(BaseModel):
    """The data of a request: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


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


REQUESTS: dict[str, type[Request]] = {
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
