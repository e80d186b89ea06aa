"""Who the page lets in."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from gateway.support.credentials import AccessToken, CredentialError
from gateway.viewer import gate
from gateway.viewer.gate import Door, Gate, Refused, RequestHead, Right
from tests.patience import PATIENCE_S

TOKEN = "abcdefghijklmnop-_09"
SESSION = "a-session-of-this-very-test"


def request(path="/", host="lab:8080", **headers):
    lines = [f"GET {path} HTTP/1.1", f"Host: {host}"]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    return RequestHead(("\r\n".join(lines) + "\r\n\r\n").encode())


def refusal(door, asked):
    with pytest.raises(Refused) as caught:
        door.admit(asked)
    return caught.value.answer.decode()


GUARDED = Door(AccessToken(TOKEN), SESSION)


@pytest.mark.parametrize(
    "asked",
    [
        request(),
        request("/?token="),
        request(f"/?token={TOKEN[:-1]}"),
        request(f"/?token={TOKEN}x"),
        request(f"/?t={TOKEN}"),
        request(Authorization=f"Basic {TOKEN}"),
        request(Authorization="Bearer"),
        request(Cookie=f"mocap_page_8080={TOKEN}"),
        request(Cookie=f"mocap_page_8081={SESSION}"),
        request(Cookie="mocap_page_8080=ä".encode().decode("latin-1").encode("ascii", "ignore").decode()),
        request(Upgrade="websocket", Origin="http://lab:8080"),
        request("/assets/index.js"),
    ],
)
def test_without_the_token_nobody_comes_in(asked):
    answer = refusal(GUARDED, asked)
    assert answer.startswith("HTTP/1.1 401")
    assert TOKEN not in answer
    assert SESSION not in answer


def test_the_token_is_shown_once_and_leaves_the_address_line():
    answer = refusal(GUARDED, request(f"/some/page?token={TOKEN}&x=1"))
    head = answer.partition("\r\n\r\n")[0].split("\r\n")
    assert head[0] == "HTTP/1.1 303 See Other"
    assert "Location: /some/page" in head
    (cookie,) = [line for line in head if line.startswith("Set-Cookie:")]
    assert cookie == f"Set-Cookie: mocap_page_8080={SESSION}; HttpOnly; SameSite=Strict; Path=/"
    assert TOKEN not in answer
    GUARDED.admit(request(Cookie=f"other=1; mocap_page_8080={SESSION}"))
    GUARDED.admit(request(Authorization=f"bearer {TOKEN}"))


LOOKING = "only-looks-at-the-page"


def test_who_shows_the_token_for_looking_may_only_look():
    door = Door(AccessToken(TOKEN), SESSION, looking=AccessToken(LOOKING))
    assert door.admit(request(Authorization=f"Bearer {TOKEN}")) is Right.WRITE
    assert door.admit(request(Authorization=f"Bearer {LOOKING}")) is Right.LOOK
    answer = refusal(door, request(f"/?token={LOOKING}"))
    (cookie,) = [line for line in answer.split("\r\n") if line.startswith("Set-Cookie:")]
    kept = cookie.removeprefix("Set-Cookie: ").partition(";")[0]
    assert SESSION not in kept
    assert door.admit(request(Cookie=kept)) is Right.LOOK
    assert door.admit(request(Cookie=f"mocap_page_8080={SESSION}")) is Right.WRITE
    raised = refusal(door, request(f"/?token={TOKEN}", Cookie=kept))  # who looked shows the other token
    assert SESSION in raised
    assert refusal(door, request(host="localhost:8080")).startswith("HTTP/1.1 401"), "this machine's too"
    foreign = request(Upgrade="websocket", Origin="https://evil.example", Cookie=kept)
    assert refusal(door, foreign).startswith("HTTP/1.1 403")


def test_one_token_cannot_have_two_rights():
    with pytest.raises(CredentialError, match="differ"):
        Door(AccessToken(TOKEN), looking=AccessToken(TOKEN))


async def test_who_only_looks_never_reaches_the_page_with_the_buttons():
    async with (
        await asyncio.start_server(answering("with buttons"), "127.0.0.1", 0) as writing,
        await asyncio.start_server(answering("without"), "127.0.0.1", 0) as looking,
    ):
        inner, without = (server.sockets[0].getsockname()[1] for server in (writing, looking))
        door = Door(AccessToken(TOKEN), looking=AccessToken(LOOKING))
        async with Gate("127.0.0.1", 0, inner, door, without) as opened:
            for token, expected in ((TOKEN, "with buttons"), (LOOKING, "without")):
                for kind in ("", "Upgrade: websocket\r\n"):
                    head = f"Host: 127.0.0.1:{opened.port}\r\nAuthorization: Bearer {token}\r\n{kind}"
                    assert (await ask(opened.port, f"GET / HTTP/1.1\r\n{head}\r\n")).endswith(expected)
        async with Gate("127.0.0.1", 0, inner, door) as opened:
            head = f"Host: 127.0.0.1:{opened.port}\r\nAuthorization: Bearer {LOOKING}"
            assert (await ask(opened.port, f"GET / HTTP/1.1\r\n{head}\r\n\r\n")).startswith("HTTP/1.1 403")


def answering(text):
    """What serves a page that consists of the text."""

    async def serve(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\n\r\n" + text.encode())
        writer.close()

    return serve


def test_a_new_start_asks_for_the_token_again():
    refusal(Door(AccessToken(TOKEN)), request(Cookie=f"mocap_page_8080={SESSION}"))


@pytest.mark.parametrize("location", ["//evil.example", "/\\evil", "/a%0d%0aSet-Cookie:x"])
def test_a_link_with_the_token_leads_nowhere_else(location):
    answer = refusal(GUARDED, request(f"{location}?token={TOKEN}"))
    (line,) = [line for line in answer.split("\r\n") if line.startswith("Location:")]
    assert not line.startswith(("Location: //", "Location: /\\"))
    assert answer.count("Set-Cookie:") == 1


@pytest.mark.parametrize(
    ("host", "is_admitted"),
    [
        ("127.0.0.1:8080", True),
        ("localhost:8080", True),
        ("[::1]:8080", True),
        ("LOCALHOST", True),
        ("rebound.example:8080", False),
        ("192.168.1.7:8080", False),
        ("", False),
    ],
)
def test_without_a_token_only_names_of_this_machine(host, is_admitted):
    if is_admitted:
        Door(None).admit(request(host=host))
    else:
        assert refusal(Door(None), request(host=host)).startswith("HTTP/1.1 403")


def test_another_site_cannot_press_the_buttons():
    door = Door(None)
    door.admit(request(host="localhost:8080", Upgrade="websocket", Origin="http://localhost:8080"))
    door.admit(request(host="localhost:8080", Upgrade="websocket"))  # no browser
    for origin in ("https://evil.example", "http://localhost:8081", "null", "http://localhost"):
        asked = request(host="localhost:8080", Upgrade="websocket", Origin=origin)
        assert refusal(door, asked).startswith("HTTP/1.1 403")


@pytest.mark.parametrize(
    "head",
    [
        b"",
        b"\r\n\r\n",
        b"GET /\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost:99999999\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: [\r\n\r\n",
        b"GET / HTTP/1.1\r\nno colon\r\n\r\n",
        b"GET /\xff HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ],
)
def test_what_is_no_plain_request_is_refused(head):
    with pytest.raises(Refused):
        RequestHead(head)


@contextlib.asynccontextmanager
async def gated(token=None):
    """A gate before a server that says what it was asked, and then repeats what it receives."""

    async def serve(reader, writer):
        head = await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\n\r\n" + head.split(b" ")[1])
        if b"websocket" in head:
            while data := await reader.read(100):
                writer.write(data)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    inner = server.sockets[0].getsockname()[1]
    async with server, Gate("127.0.0.1", 0, inner, Door(token)) as gate_:
        yield gate_.port


async def ask(port, text):
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(text.encode())
    async with asyncio.timeout(PATIENCE_S):
        answer = await reader.read()
    writer.close()
    return answer.decode()


async def test_what_may_pass_passes_both_ways():
    async with gated() as port:
        host = f"Host: 127.0.0.1:{port}"
        assert (await ask(port, f"GET /page HTTP/1.1\r\n{host}\r\n\r\n")).endswith("/page")
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"GET /ws HTTP/1.1\r\n{host}\r\nUpgrade: websocket\r\n\r\n".encode())
        assert (await reader.readuntil(b"/ws")).startswith(b"HTTP/1.1 200")
        writer.write(b"pressed")
        assert await reader.readexactly(7) == b"pressed"
        writer.close()


async def test_a_second_request_of_a_connection_is_not_passed_on_unseen():
    async with gated() as port:
        first = f"GET /a HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"
        answer = await ask(port, first + first.replace("/a", "/hidden"))
    assert "/a" in answer
    assert "/hidden" not in answer


async def test_requests_too_long_and_too_slow(monkeypatch):
    monkeypatch.setattr(gate, "FIRST_REQUEST_S", 0.3)
    async with gated(AccessToken(TOKEN)) as port:
        assert (await ask(port, "GET /" + "x" * gate.LARGEST_HEAD)).startswith("HTTP/1.1 431")
        assert await ask(port, "GET / HTTP/1.1\r\n") == ""
