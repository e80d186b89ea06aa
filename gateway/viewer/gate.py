"""What stands before the page: who may come in, and from where.

The page's own server listens on loopback and answers this gate alone, which shows it a pass with every
request. The gate passes on what may pass:

* With a token: ``http://HOST:PORT/?token=TOKEN`` once, or ``Authorization: Bearer TOKEN``. The answer sets a
  cookie that stands for it, so that the token does not stay in the browser's address line.
* A second token lets in to look only: whoever shows it is passed on to another server, whose page has no
  buttons that ask anything of the gateway, and no code behind any.
* A WebSocket only from the page itself: any other site open in the same browser could otherwise press its
  buttons (``Origin`` and ``Host`` must name the same place).
* In no frame of another site.
* Without a token only under a name of this machine, against names that are made to point here.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.cookies
import logging
import secrets
import urllib.parse
from collections.abc import Coroutine
from enum import Enum
from types import TracebackType
from typing import NamedTuple, Self

from gateway.errors import OutputError
from gateway.support.credentials import AccessToken, CredentialError, leads_here
from gateway.support.crowd import Crowd, CrowdedError

LARGEST_HEAD = 16 * 1024
"""Bytes of a request, before its body; none has a body."""
MOST_CLIENTS = 64
"""Connections at one time. A browser takes up to six while it loads."""
MOST_OF_ONE_ADDRESS = 48
"""Of those, with a request that is being answered."""
PASS_HEADER = "X-Mocap-Gate"
"""What the gate adds to the head of each request. The server behind it answers no request without."""
FIRST_REQUEST_S = 3.0
"""For a request to arrive."""
_LAST_WORDS_S = 1.0
_BLOCK = 64 * 1024
_NOT_FRAMED = "Content-Security-Policy: frame-ancestors 'none'", "X-Frame-Options: DENY"
"""Within a frame of another site its buttons could be pressed by somebody who sees something else."""
_CROWDED = "503 Service Unavailable", "too many connections are open already"
_log = logging.getLogger(__name__)


class Refused(Exception):
    """An answer that is not the page: status line, and a line for people."""

    def __init__(self, status: str, text: str, *headers: str) -> None:
        self.answer = "\r\n".join(
            (
                f"HTTP/1.1 {status}",
                "Content-Type: text/plain; charset=utf-8",
                # One more for the line feed behind the text.
                f"Content-Length: {len(text.encode()) + 1}",
                "Connection: close",
                *_NOT_FRAMED,
                *headers,
                "",
                f"{text}\n",
            )
        ).encode()
        super().__init__(status)


class RequestHead:
    """The head of an HTTP request. Raises ``Refused`` for what is none."""

    def __init__(self, head: bytes) -> None:
        try:
            first, *lines = head.decode("ascii").split("\r\n")
            method, self.path, version = first.split(" ")
            pairs = [line.split(":", 1) for line in lines if line]
            self.headers = {name.strip().lower(): value.strip() for name, value in pairs}
            self.host = self.headers.get("host", "").lower()
            """Name and port under which the browser knows the page."""
            self.host_port = urllib.parse.urlsplit(f"//{self.host}").port or 80
        except ValueError:
            raise Refused("400 Bad Request", "this is no HTTP request") from None
        # A body that this gate and the page behind measured differently would smuggle a second request.
        has_body = self.headers.keys() & {"transfer-encoding", "content-length"}
        if (
            method != "GET"
            or not version.startswith("HTTP/1.")
            or has_body
            # Two headers of one name: which one counts would be for each program to decide.
            or len(pairs) != len(self.headers)
        ):
            raise Refused("405 Method Not Allowed", "the page is read with GET", "Allow: GET")

    @property
    def is_websocket(self) -> bool:
        """Whether it asks for the connection that poses go and buttons come over."""
        return self.headers.get("upgrade", "").lower() == "websocket"


class Right(Enum):
    """What somebody may do who is let in."""

    LOOK = "look"
    WRITE = "write"
    """Press buttons that ask something of the gateway, too."""


class _Key(NamedTuple):
    """A token, and the cookie that stands for it."""

    right: Right
    token: AccessToken
    session: str


class Door:
    """Decides about requests. No I/O."""

    def __init__(
        self,
        token: AccessToken | None,
        session: str | None = None,
        looking: AccessToken | None = None,
    ) -> None:
        """Make the keys of the page.

        token: of who may write.
        looking: of who may only look; None: nobody may only look.
        session: what the writer's cookie holds; None: random, so that a new start asks for the token again.

        Raises ``CredentialError`` where both tokens are the same.
        """
        if token is not None and looking is not None and looking.matches(token.reveal()):
            raise CredentialError("who may look would also write: make the two tokens of the page differ")
        self._keys = [
            _Key(right, each, secrets.token_urlsafe(32))
            for right, each in ((Right.WRITE, token), (Right.LOOK, looking))
            if each is not None
        ]
        if session is not None:
            self._keys = [
                key._replace(session=session) if key.right is Right.WRITE else key for key in self._keys
            ]

    def admit(self, request: RequestHead) -> Right:
        """Return what may be done. Raises ``Refused`` for a request that may not come in.

        ``Refused`` is also raised to set the cookie for a request that shows a token.
        """
        is_open = not self._keys and leads_here(f"//{request.host}")
        right = Right.WRITE if is_open else self._identify(request)
        # A browser sends cookies with requests of any site: only the origin says which site opened the
        # socket.
        origin = request.headers.get("origin", request.host).lower()
        if request.is_websocket and origin.rpartition("/")[2] != request.host:
            raise Refused("403 Forbidden", "another site may not use this page")
        return right

    def _identify(self, request: RequestHead) -> Right:
        if not self._keys:
            raise Refused(
                "403 Forbidden", "without a token this page is served as localhost and 127.0.0.1 only"
            )
        kind, _, bearer = request.headers.get("authorization", "").partition(" ")
        cookie = http.cookies.SimpleCookie()
        with contextlib.suppress(http.cookies.CookieError):
            cookie.load(request.headers.get("cookie", ""))
        kept = cookie.get(self._cookie_name(request))
        path, _, query = request.path.partition("?")
        (shown, *_) = urllib.parse.parse_qs(query).get("token", [""])
        for key in self._keys:
            if kind.lower() == "bearer" and key.token.matches(bearer.strip()):
                return key.right
        for key in self._keys:  # before the cookie: another token is shown to have another right
            if key.token.matches(shown):
                raise self._welcome(request, path, key.session)
        for key in self._keys:
            if kept and AccessToken(key.session).matches(kept.value):
                return key.right
        raise Refused(
            "401 Unauthorized",
            "this page needs its token: open it as …/?token=TOKEN",
            'WWW-Authenticate: Bearer realm="mocap-gateway"',
        )

    def _welcome(self, request: RequestHead, path: str, session: str) -> Refused:
        return Refused(
            "303 See Other",
            "welcome",
            "Location: /" + urllib.parse.quote(path.lstrip("/\\")),  # two slashes would be another host
            f"Set-Cookie: {self._cookie_name(request)}={session}; HttpOnly; SameSite=Strict; Path=/",
            "Referrer-Policy: no-referrer",
            "Cache-Control: no-store",
        )

    def _cookie_name(self, request: RequestHead) -> str:
        """Return the cookie's name, which has the port: browsers share cookies between ports of a host."""
        return f"mocap_page_{request.host_port}"


class Gate:
    """Listens at ``host:port`` and lets through to a server on loopback. Belongs to one event loop."""

    def __init__(
        self,
        host: str,
        port: int,
        inner_port: int,
        door: Door,
        looking_port: int | None = None,
        gate_pass: AccessToken | None = None,
    ) -> None:
        """Forward to the pages behind the gate.

        inner_port: of the page with its buttons.
        looking_port: of the one without; None: whoever may only look is refused.
        gate_pass: what the servers behind the gate ask for; None: they ask for nothing.
        """
        self._address = host, port
        self._pass_line = b"" if gate_pass is None else f"{PASS_HEADER}: {gate_pass.reveal()}\r\n".encode()
        self._inner_ports = {Right.WRITE: inner_port, Right.LOOK: looking_port}
        self._door = door
        self._clients: set[asyncio.Task[None]] = set()
        self._crowd: Crowd[asyncio.Task[None]] = Crowd(MOST_CLIENTS, MOST_OF_ONE_ADDRESS)
        self._server: asyncio.Server | None = None

    @property
    def port(self) -> int:
        """Where it listens; with 0 asked for, the one that was found free."""
        assert self._server is not None
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    async def __aenter__(self) -> Self:
        try:
            self._server = await asyncio.start_server(self._take, *self._address, limit=LARGEST_HEAD)
        except OSError as error:
            host, port = self._address
            raise OutputError(
                f"the page cannot listen on {host}:{port} ({error.strerror}): name another one with "
                "--page-port or --page-host"
            ) from error
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            self._server.close()
        for client in self._clients:
            client.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)

    def _take(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = asyncio.create_task(self._serve(reader, writer), name="client of the page")
        self._clients.add(client)
        client.add_done_callback(self._clients.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = asyncio.current_task()
        assert client is not None
        try:
            silent = self._crowd.enter(client, str(writer.get_extra_info("peername")[0]))
            if silent is not None:
                silent.cancel()
            await self._pass_on(reader, writer)
        except CrowdedError:
            with contextlib.suppress(OSError, TimeoutError):
                await _answer(reader, writer, Refused(*_CROWDED).answer)
        except Refused as refused:
            with contextlib.suppress(OSError, TimeoutError):
                await _answer(reader, writer, refused.answer)
        except (OSError, EOFError, TimeoutError) as error:
            _log.debug("a client of the page went: %r", error)
        finally:
            self._crowd.leave(client)
            writer.close()

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(FIRST_REQUEST_S):
                head = await reader.readuntil(b"\r\n\r\n")
        except asyncio.LimitOverrunError:
            raise Refused("431 Request Header Fields Too Large", "the request is too long") from None
        request = RequestHead(head)
        client = asyncio.current_task()
        assert client is not None
        self._crowd.note_request(client)
        inner_port = self._inner_ports[self._door.admit(request)]
        if inner_port is None:
            raise Refused("403 Forbidden", "there is no page to only look at here")
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", inner_port)
        try:
            inner_writer.write(head.removesuffix(b"\r\n") + self._pass_line + b"\r\n")
            if request.is_websocket:
                await _either(_copy(reader, inner_writer), _copy(inner_reader, writer))
            else:  # one request a connection: nothing that comes after it was looked at
                answer = await inner_reader.readuntil(b"\r\n")
                writer.write(answer + "".join(f"{line}\r\n" for line in _NOT_FRAMED).encode())
                await _copy(inner_reader, writer)
        finally:
            inner_writer.close()


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, answer: bytes) -> None:
    """Send an answer and wait until the client has closed: unread input would discard the answer."""
    async with asyncio.timeout(_LAST_WORDS_S):
        writer.write(answer)
        await writer.drain()
        writer.write_eof()
        await reader.read(LARGEST_HEAD)


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    """Copy until the source ends; a slow reader is waited for, so that nothing piles up."""
    while block := await source.read(_BLOCK):
        target.write(block)
        await target.drain()


async def _either(*ways: Coroutine[None, None, None]) -> None:
    """Run both directions until one of them ends, then end the other."""
    tasks = [asyncio.create_task(way) for way in ways]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
