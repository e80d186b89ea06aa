"""Where poses go beside MQTT. All of it is off unless configured."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from gateway.outputs.settings import PoseMap


class _Output(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    rate: float = Field(default=60, gt=0, le=1000, allow_inf_nan=False, description="most poses a second, Hz")


class _Datagrams(_Output):
    host: str = Field(
        default="127.0.0.1",
        min_length=1,
        description="where they are sent: loopback, unless another machine listens",
    )


class VmcSettings(_Datagrams):
    """VMC protocol (OSC over UDP), for Unity, Blender and VR apps: bodies of people only."""

    port: int = Field(default=39539, ge=1, le=65535, description="UDP port of the app")


class UdpJsonSettings(_Datagrams):
    """The messages of topic ``pose``, each a datagram."""

    port: int = Field(default=39600, ge=1, le=65535, description="UDP port of the app")
    include: frozenset[PoseMap] = Field(
        default=frozenset(), description="what a pose carries beside orientations and status, as in mqtt"
    )


class LslSettings(_Output):
    """A stream of the Lab Streaming Layer (extra ``lsl``). LSL itself announces it in the whole network."""

    name: str = Field(default="mocap", min_length=1, max_length=64, description="name of the stream")


class OutputsSettings(BaseModel):
    """Outputs beside MQTT; none: off."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    vmc: VmcSettings | None = Field(default=None, description="avatars, by the VMC protocol; {}: defaults")
    udp_json: UdpJsonSettings | None = Field(default=None, description="poses as JSON over UDP")
    lsl: LslSettings | None = Field(default=None, description="orientations as an LSL stream")
