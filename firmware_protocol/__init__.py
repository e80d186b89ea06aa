"""The wire between the modules of a suit and the gateway. Sans-I/O: bytes in, values out.

A module's side::

    sample = InertialSample(specific_force=(0.0, 0.0, 9.81), angular_rate=(0.0, 0.1, 0.0))
    frame = wire_frame(sample, module=3, sequence=17, module_time_us=1_250_000)
    sent = encode_frame(frame)  # byte stream
    sent = pack_can_records(fragment(frame))  # CAN bus

The gateway's side::

    decoder = PacketDecoder(FrameDecoder())  # or PacketDecoder(CanFrameDecoder())
    for received in decoder.feed(chunk):
        received.module, received.module_time_us, received.packet
    decoder.dropped  # Counter of Defect: every drop has a name

Chunks may be cut anywhere (byte stream) or hold any number of whole records (CAN). Decoders never
raise; encoders raise ValueError, naming the field, for what cannot be sent.

Commands go the other way: ``wire_frame(Command(...), module, ...)`` with arguments made by
``encode_arguments``; the module's end decodes them with a ``PacketDecoder`` of its own.

Reading order: ``fields`` (what a declaration says), ``kinds``, ``framing`` with ``stuffing``, ``samples``
and ``messages`` (the packets' declarations), ``commands``, ``device_settings``; then how they are worked
with: ``codec`` (bodies from declarations), ``packets``, ``relay``, ``can_framing``, ``can_transfer``,
``signing``, ``flash_slots``, ``capacity``. All else is made of the declarations: ``README.md`` for firmware
authors by ``document`` (and ``prose``), ``vectors/`` by ``golden``, ``module.dbc`` by ``dbc``, the C header
by ``c``.

A new packet is a dataclass in ``samples`` or ``messages``, a line in ``kinds`` and one in ``packets``, and
an example in ``golden``; a new verb is a line in ``commands``, a new setting one in ``device_settings``.
Then each of these files is written anew.
"""

from firmware_protocol.can_framing import (
    CanFrame,
    CanFrameDecoder,
    fragment,
    pack_can_records,
    unpack_can_records,
)
from firmware_protocol.can_transfer import (
    TransferParams,
    TransferPiece,
    TransferReceiver,
    TransferSender,
    TransferState,
)
from firmware_protocol.commands import (
    VERBS,
    Result,
    Verb,
    VerbDeclaration,
    decode_arguments,
    decode_payload,
    encode_arguments,
    encode_payload,
)
from firmware_protocol.device_settings import (
    SETTINGS,
    Setting,
    decode_value,
    encode_value,
    factory_settings,
)
from firmware_protocol.flash_slots import (
    Flash,
    FlashError,
    SlotStore,
)
from firmware_protocol.framing import (
    BROADCAST,
    DELIMITER,
    MAX_FRAME_SIZE,
    MAX_MODULE,
    PROTOCOL_VERSION,
    RELAY,
    SUPPORTED,
    Defect,
    FrameDecoder,
    VersionRange,
    WireFrame,
    encode_frame,
    negotiate,
)
from firmware_protocol.kinds import (
    FROM_HOST,
    Kind,
)
from firmware_protocol.messages import (
    ANYONE,
    Acknowledgement,
    Command,
    DeviceInfo,
    Event,
    Health,
    LogLine,
    SamplingTrigger,
    SyncRequest,
    SyncResponse,
    TransferToHost,
    TransferToModule,
)
from firmware_protocol.packets import (
    PACKETS,
    Packet,
    PacketDecoder,
    ReceivedPacket,
    WireFrameDecoder,
    decode_body,
    encode_packet,
    wire_frame,
)
from firmware_protocol.relay import (
    relay_batch,
)
from firmware_protocol.samples import (
    FusedSample,
    InertialSample,
    InertialSampleFine,
    LightSample,
    LocalMeasurement,
    PassThrough,
    PressureSample,
    Quaternion,
    Vector3,
)

__all__ = [
    "ANYONE",
    "BROADCAST",
    "DELIMITER",
    "FROM_HOST",
    "MAX_FRAME_SIZE",
    "MAX_MODULE",
    "PACKETS",
    "PROTOCOL_VERSION",
    "RELAY",
    "SETTINGS",
    "SUPPORTED",
    "VERBS",
    "Acknowledgement",
    "CanFrame",
    "CanFrameDecoder",
    "Command",
    "Defect",
    "DeviceInfo",
    "Event",
    "Flash",
    "FlashError",
    "FrameDecoder",
    "FusedSample",
    "Health",
    "InertialSample",
    "InertialSampleFine",
    "Kind",
    "LightSample",
    "LocalMeasurement",
    "LogLine",
    "Packet",
    "PacketDecoder",
    "PassThrough",
    "PressureSample",
    "Quaternion",
    "ReceivedPacket",
    "Result",
    "SamplingTrigger",
    "Setting",
    "SlotStore",
    "SyncRequest",
    "SyncResponse",
    "TransferParams",
    "TransferPiece",
    "TransferReceiver",
    "TransferSender",
    "TransferState",
    "TransferToHost",
    "TransferToModule",
    "Vector3",
    "Verb",
    "VerbDeclaration",
    "VersionRange",
    "WireFrame",
    "WireFrameDecoder",
    "decode_arguments",
    "decode_body",
    "decode_payload",
    "decode_value",
    "encode_arguments",
    "encode_frame",
    "encode_packet",
    "encode_payload",
    "encode_value",
    "factory_settings",
    "fragment",
    "negotiate",
    "pack_can_records",
    "relay_batch",
    "unpack_can_records",
    "wire_frame",
]
