"""One connection to the broker, opened and closed within bounded time, and read within bounded memory.

aiomqtt leaves two things to its user that matter when a broker freezes: a connection that is given
up stays open (and its timer runs on), and a disconnection waits for a broker that will not answer.
Whoever may publish there decides how large and how many messages are.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import re
import secrets
import socket
import ssl
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import aiomqtt
from aiomqtt.exceptions import MqttConnectError
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from devices.back_off import BackOff
from gateway.errors import OutputError
from gateway.outputs.settings import PASSWORD_VARIABLE, MqttSettings, TlsSettings
from gateway.support.credentials import CredentialError

if TYPE_CHECKING:
    from paho.mqtt.client import SocketLike

LARGEST_MESSAGE = 1 << 20
"""Bytes; as in the shipped configuration of mosquitto. Poses of 60 segments with everything have 30 kB."""
LARGEST_INBOX = 16 << 20
"""Bytes of messages that wait to be read."""
MOST_MESSAGES = 1000

_log = logging.getLogger(__name__)


class Inbox(asyncio.Queue[aiomqtt.Message]):
    """Messages that wait; full by their number, or by their bytes. aiomqtt drops what does not fit."""

    def __init__(self, maxsize: int = MOST_MESSAGES, on_full: Callable[[], None] | None = None) -> None:
        """on_full: told of every message that does not fit."""
        super().__init__(maxsize)
        self._bytes = 0
        self._on_full = on_full

    def put_nowait(self, item: aiomqtt.Message) -> None:
        """Put a message into the queue. Raises ``QueueFull``."""
        size = _size(item)
        if self.full() or size > LARGEST_MESSAGE or self._bytes + size > LARGEST_INBOX:
            if self._on_full is not None:
                self._on_full()
            raise asyncio.QueueFull
        super().put_nowait(item)
        self._bytes += size

    def _get(self) -> aiomqtt.Message:
        item = super()._get()
        self._bytes -= _size(item)
        return item


def _size(message: aiomqtt.Message) -> int:
    payload = message.payload
    return len(payload) if isinstance(payload, bytes | bytearray | str) else 0


def refuse_huge_packets(client: Any) -> None:
    """Have a paho client hang up as soon as a packet says that it is huge, not when all of it has come.

    MQTT 3.1.1 has no way to tell the broker; a packet may have 256 MB.
    """
    read: Callable[..., Any] = client.loop_read

    def guarded(max_packets: int = 1) -> Any:
        result = read(max_packets)
        announced = client._in_packet["remaining_length"]
        if announced > LARGEST_MESSAGE + _LONGEST_HEAD:
            _log.warning(
                "the broker sends a message of %.1f MB, more than the %.1f MB that are read: hung up; "
                "let it refuse them (mosquitto: max_packet_size)",
                announced * 1e-6,
                LARGEST_MESSAGE * 1e-6,
            )
            client._sock_close()
            raise ConnectionError(f"a message of {announced} bytes")
        return result

    client.loop_read = guarded


_LONGEST_HEAD = 1 << 17
"""Bytes of topic and properties before a payload: two texts of 64 kB."""


class Allowance:
    """So many a second on average, and so many at once. Time is an argument, s."""

    def __init__(self, rate: float, burst: int) -> None:
        self._rate = rate
        self._burst = burst
        self._left = float(burst)
        self._at_s = -math.inf

    def takes(self, now_s: float) -> bool:
        """Return whether one more is within it; it then counts."""
        gained = (now_s - self._at_s) * self._rate if math.isfinite(self._at_s) else 0.0
        self._left = min(float(self._burst), self._left + max(gained, 0.0))
        self._at_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


TIMEOUT_S = 2.0
"""Longest wait for the broker to take a connection, or a message, before it counts as lost."""

# Without TCP_NODELAY a pose waits for the acknowledgement of the one before: up to 40 ms. The small
# send buffer keeps a frozen broker from swallowing many seconds of poses that nobody will want.
_SOCKET_OPTIONS = (
    (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
    (socket.SOL_SOCKET, socket.SO_SNDBUF, 64 * 1024),
)
# What paho logs is an echo of the exceptions that ``explain`` puts into words.
_CLIENT_LOGGER = logging.getLogger(f"{__name__}.paho")
_CLIENT_LOGGER.setLevel(logging.CRITICAL)

_PROTOCOLS = {"3.1.1": aiomqtt.ProtocolVersion.V311, "5": aiomqtt.ProtocolVersion.V5}

# CONNACK reason codes (MQTT 5, table 3-1); paho gives those of MQTT 3.1.1 the same numbers.
_UNSUPPORTED_PROTOCOL = 132
_BAD_CREDENTIALS = 134
_NOT_AUTHORISED = 135

_CANCEL_AGAIN_S = 0.5
_NUMBER = re.compile(r"\[(Errno -?\d+|code:\d+)\] ")
"""Before what the system, or the client, says of an error."""


def broker_back_off() -> BackOff:
    """Return the waits between attempts to reach a broker: short, since poses are lost meanwhile."""
    return BackOff(0.2, 1.0)


@asynccontextmanager
async def broker_connection(
    settings: MqttSettings,
    port: int,
    identifier: str,
    will: aiomqtt.Will | None = None,
    on_full: Callable[[], None] | None = None,
    on_answer: Callable[[str, ReasonCode], None] | None = None,
    most_messages: int = MOST_MESSAGES,
    timeout_s: float = TIMEOUT_S,
) -> AsyncIterator[aiomqtt.Client]:
    """Give a connected client, disconnected on leaving.

    on_full: told of every message that was dropped because too many, or too large ones, wait to be read.
    on_answer: told topic and reason code of every publication of QoS 1 that was answered; with MQTT 3.1.1
    it is always success. most_messages: so many wait to be read, within ``LARGEST_INBOX``. timeout_s: longest
    wait for the broker to let us in, or to answer a message.

    Raises ``aiomqtt.MqttError``, ``OSError`` or ``CredentialError``; ``explain`` puts them into words.

    Left by an exception, the socket is closed at once without a farewell, so that the broker
    publishes the will.
    """
    client = _client(settings, port, identifier, will, partial(Inbox, on_full=on_full), most_messages)
    client.timeout = timeout_s
    if on_answer is not None:
        _report_acknowledgements(client, on_answer)
    try:
        # Not "async with": its exit waits for a broker that may be frozen, after any exception.
        await client.__aenter__()
        yield client
        await client.__aexit__(None, None, None)
    finally:
        _hang_up(client)


def publish_unawaited(
    client: aiomqtt.Client, topic: str, payload: bytes, properties: Properties | None
) -> None:
    """Publish with QoS 1; only ``on_answer`` of the connection is told how the broker answered."""
    client._client.publish(topic, payload, 1, properties=properties)


def explain(error: BaseException, settings: MqttSettings, port: int) -> str:
    """Return one line: what went wrong with the broker, and what would do. Never holds the password."""
    where = f"{settings.host}:{port}"
    if isinstance(error, CredentialError):
        return str(error)
    if isinstance(error, MqttConnectError):
        return _explain_refusal(error.rc, settings, where)
    reason = reason_of(error)
    if "SSL" in reason:
        return f"no TLS connection to the broker at {where} ({reason}): check tls.ca_file and the host name"
    if "timed out" in reason:
        return f"the MQTT broker at {where} does not answer: is it frozen, or does it expect TLS (see tls)?"
    hint = "is the embedded broker running?"
    if settings.broker == "external":
        hint = "is mosquitto running? (broker: embedded needs none)"
    return f"no MQTT broker at {where} ({reason}): {hint}"


def reason_of(error: BaseException) -> str:
    """Return what an error says without its number, and in words where the library has none."""
    return _NUMBER.sub("", str(error)).replace("Unspecified error", "it hung up")


def _explain_refusal(code: int | ReasonCode | None, settings: MqttSettings, where: str) -> str:
    number = code.value if isinstance(code, ReasonCode) else code
    if number == _UNSUPPORTED_PROTOCOL:
        return f'the broker at {where} does not speak MQTT {settings.protocol_in_use}: set protocol: "3.1.1"'
    if number not in (_BAD_CREDENTIALS, _NOT_AUTHORISED):
        return f"the broker at {where} refuses the connection ({code})"
    if settings.username is None:
        return f"the broker at {where} refuses clients without a name ({code}): set username"
    return (
        f"the broker at {where} refuses user '{settings.username}' ({code}): "
        f"check username, and password_file or {PASSWORD_VARIABLE}"
    )


def check_files(settings: MqttSettings) -> None:
    """Read what a connection needs of files. Raises ``CredentialError`` for one that cannot be read."""
    if settings.username is not None:
        settings.read_password()
    if settings.tls is not None:
        _tls_parameters(settings.tls)


async def check_admittance(settings: MqttSettings, port: int) -> None:
    """Connect once, for a moment. Raises ``OutputError`` where the broker refuses us; one that is away may
    come yet, which is logged."""
    try:
        async with broker_connection(settings, port, unique_identifier("check")):
            pass
    except MqttConnectError as error:
        raise OutputError(explain(error, settings, port)) from error
    except (aiomqtt.MqttError, OSError) as error:
        logging.getLogger(__name__).warning("%s", explain(error, settings, port))


def _client(
    settings: MqttSettings,
    port: int,
    identifier: str,
    will: aiomqtt.Will | None,
    new_inbox: Callable[..., Inbox],
    most_messages: int,
) -> aiomqtt.Client:
    client = aiomqtt.Client(
        settings.host,
        port,
        username=settings.username,
        password=settings.read_password() if settings.username is not None else None,
        logger=_CLIENT_LOGGER,
        identifier=identifier,
        protocol=_PROTOCOLS[settings.protocol_in_use],
        will=will,
        timeout=TIMEOUT_S,
        keepalive=settings.keepalive,
        queue_type=new_inbox,  # type: ignore[arg-type]  # it is only called
        max_queued_incoming_messages=most_messages,
        properties=_wishes(settings),
        tls_params=_tls_parameters(settings.tls) if settings.tls is not None else None,
        socket_options=_SOCKET_OPTIONS,
    )
    refuse_huge_packets(client._client)
    client._client.connect_timeout = TIMEOUT_S  # aiomqtt has no parameter for it; paho's 5 s is long
    _watch_open_sockets_only(client)
    _write_at_once(client)
    _notice_early_hang_up(client)
    return client


def _report_acknowledgements(client: aiomqtt.Client, on_answer: Callable[[str, ReasonCode], None]) -> None:
    """Have the answers to publications told by topic; aiomqtt waits for them and does not read them."""
    paho, topics = client._client, dict[int, str]()
    publish, on_publish = paho.publish, cast(Callable[..., None] | None, paho.on_publish)

    def noted(topic: str, payload: Any = None, qos: int = 0, *arguments: Any, **options: Any) -> Any:
        info = publish(topic, payload, qos, *arguments, **options)
        if qos:
            topics[info.mid] = topic
        return info

    def published(one: Any, data: Any, mid: int, code: ReasonCode, *more: Any) -> None:
        topic = topics.pop(mid, None)
        if topic is not None:
            on_answer(topic, code)
        if on_publish is not None:
            on_publish(one, data, mid, code, *more)

    paho.publish = noted  # type: ignore[method-assign]
    paho.on_publish = published


def _notice_early_hang_up(client: aiomqtt.Client) -> None:
    """Have an attempt fail at once when the other side closes it before it has answered.

    aiomqtt waits for the answer to its time-out: with a port forwarder in between, which takes connections
    for a broker that is away, every attempt took two seconds. And it fails itself over one that is given up
    just as the other side closes it, which nobody waits to hear of.
    """
    original = client._client.on_disconnect

    def disconnected(*arguments: Any) -> None:
        if client._connected.cancelled():
            return
        if client._connected.done():
            assert original is not None
            original(*arguments)
        else:
            client._connected.set_exception(aiomqtt.MqttError("it hung up before it had answered"))
            client._connected.exception()  # told here: where nobody waits any more, asyncio need not complain

    client._client.on_disconnect = disconnected


def _write_at_once(client: aiomqtt.Client) -> None:
    """Have what is published handed to the system at once, as far as it takes it.

    Otherwise the loop is asked to say when the socket can be written, which takes several turns for every
    message: where each turn has samples to handle, poses piled up in front of a broker that was idle.
    """
    paho = client._client
    publish = paho.publish

    def written(*arguments: Any, **options: Any) -> Any:
        info = publish(*arguments, **options)
        paho.loop_write()
        return info

    paho.publish = written  # type: ignore[method-assign]


def _watch_open_sockets_only(client: aiomqtt.Client) -> None:
    """Have the loop watch a new or a full socket only if it is still open when the loop gets to it.

    aiomqtt hands the loop the socket's number. A broker that dies, or a connection given up while it is
    being made, closes the socket in between: the number is nobody's by then, or a serial port's that has
    just been opened.
    """
    loop = client._loop

    def attempted(step: Callable[[], object]) -> None:
        try:
            step()
        except Exception as error:  # as aiomqtt does: whatever it is, the connection is lost
            if not client._disconnected.done():
                client._disconnected.set_exception(error)

    def watch_reading(sock: SocketLike) -> None:
        if sock.fileno() >= 0:
            loop.add_reader(sock.fileno(), attempted, partial(_read_all, client))
            client._misc_task = loop.create_task(client._misc_loop())

    def watch_writing(sock: SocketLike) -> None:
        # What was written at once meanwhile needs no watching, which would outlive the socket.
        if sock.fileno() >= 0 and client._client.want_write():
            loop.add_writer(sock.fileno(), attempted, client._client.loop_write)

    def asked(watch: Callable[[SocketLike], None]) -> Callable[[object, object, SocketLike], None]:
        def in_the_loop(_client: object, _data: object, sock: SocketLike) -> None:
            loop.call_soon_threadsafe(watch, sock)

        return in_the_loop

    client._client.on_socket_open = asked(watch_reading)
    client._client.on_socket_register_write = asked(watch_writing)


def _read_all(client: aiomqtt.Client) -> None:
    """Read what has come; bytes that TLS has decoded already would not wake the loop again."""
    paho = client._client
    paho.loop_read()
    while isinstance(paho._sock, ssl.SSLSocket) and paho._sock.pending() > 0:
        paho.loop_read()


def _wishes(settings: MqttSettings) -> Properties | None:
    """Return what a broker that speaks MQTT 5 is told on connecting: the largest packet that we take."""
    if settings.protocol_in_use != "5":
        return None
    properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
    properties.MaximumPacketSize = LARGEST_MESSAGE
    return properties


def _tls_parameters(tls: TlsSettings) -> aiomqtt.TLSParameters:
    files = {"ca_file": tls.ca_file, "certificate": tls.certificate, "key": tls.key}
    for name, path in files.items():
        if path is not None and not os.access(path, os.R_OK):
            raise CredentialError(
                f"cannot read tls.{name} {path} (no such file, or not readable for this user): name another"
            )
    ca_file, certificate, key = (None if path is None else str(path) for path in files.values())
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        if ca_file is not None:
            context.load_verify_locations(ca_file)
    except OSError:
        raise CredentialError(
            f"tls.ca_file {ca_file}: holds no certificate in PEM (BEGIN CERTIFICATE): name another file"
        ) from None
    try:
        if certificate is not None:
            # A key that asks for a password would have it asked for on the terminal.
            context.load_cert_chain(certificate, key, password="")
    except (OSError, ValueError):
        raise CredentialError(
            f"tls.certificate {certificate}: with tls.key {key} it is no certificate and its key in PEM, "
            "without a password: name the two files that were made together"
        ) from None
    return aiomqtt.TLSParameters(ca_certs=ca_file, certfile=certificate, keyfile=key)


def _hang_up(client: aiomqtt.Client) -> None:
    """Close the socket, if it is still open, and end the client's timer.

    One that a thread opens later (the attempt was given up) is not watched, and closed with the client.
    """
    client._client.on_socket_open = None
    client._client._sock_close()  # aiomqtt offers only a disconnection that waits for the broker
    if client._disconnected.done() and not client._disconnected.cancelled():
        client._disconnected.exception()  # seen: or asyncio complains of it at some later time


def unique_identifier(role: str) -> str:
    """Return a client identifier that no other client has: two with the same push each other out for ever."""
    return f"mocap-{role}-{secrets.token_hex(4)}"


async def nap(seconds: float, interrupt: asyncio.Event) -> None:
    """Sleep, but no longer than until the event is set."""
    try:
        async with asyncio.timeout(seconds):
            await interrupt.wait()
    except TimeoutError:
        return


async def first_to_end(*parts: Coroutine[Any, Any, None]) -> None:
    """Run parts until one of them ends, end the others, and raise what it raised, if anything."""
    tasks = [asyncio.create_task(part) for part in parts]
    try:
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in ended:
            task.result()
    finally:
        await end_tasks(*tasks)


async def end_tasks(*tasks: asyncio.Task[None]) -> None:
    """Cancel tasks until they have ended.

    Once is not enough: a cancellation that arrives while an MQTT connection is being closed can be turned
    into a connection error there, one that arrives together with the broker's answer is lost (Python 3.11,
    ``asyncio.wait_for``), and a task that reconnects for ever would go on.
    """
    remaining = set(tasks)
    while remaining:
        for task in remaining:
            task.cancel()
        _, remaining = await asyncio.wait(remaining, timeout=_CANCEL_AGAIN_S)
    await asyncio.gather(*tasks, return_exceptions=True)
