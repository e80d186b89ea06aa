"""Links kept open for ever: the state machine with scripted faults, then real faults."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator

import pytest

from devices.back_off import BackOff
from devices.emulators.transports.memory import loopback_pair
from devices.endpoints import link_from_url
from devices.link import Chunk, Framing, Link, LinkBusyError, LinkError
from devices.links.reconnect import LinkState, LinkStatus, ReconnectingLink, kept_open
from devices.links.serial_link import SerialLink
from devices.links.tcp_link import TcpLink
from tests.patience import PATIENCE_S

UP, DOWN, CLOSED, CONNECTING = LinkState.UP, LinkState.DOWN, LinkState.CLOSED, LinkState.CONNECTING


class ScriptedLink:
    """Each opening plays the next entry: a reason not to open, or the chunks to give before the end."""

    name = "suit"
    framing = Framing.BYTE_STREAM

    def __init__(self, *script: str | list[bytes]) -> None:
        self._script = list(script)
        self._chunks: list[bytes] = []
        self.is_open = False
        self.time = 0.0

    async def open(self) -> None:
        assert not self.is_open
        entry = self._script.pop(0) if self._script else "nothing more"
        if isinstance(entry, str):
            raise (LinkBusyError if "busy" in entry else LinkError)(entry)
        self._chunks, self.is_open = entry, True

    async def __aiter__(self) -> AsyncIterator[Chunk]:
        for data in self._chunks:
            if data == b"long":
                self.time += 100.0
            else:
                yield Chunk(data, 0, self.name)
        raise LinkError("pulled")

    async def write(self, data: bytes, to=()) -> None: ...

    async def close(self) -> None:
        self.is_open = False


async def run(
    script: list[str | list[bytes]], n_delays: int
) -> tuple[list[bytes], list[float], list[LinkStatus]]:
    """Data, delays slept and changes of status until so many delays were slept."""
    delays: list[float] = []
    changes: list[LinkStatus] = []
    inner = ScriptedLink(*script)
    played = asyncio.Event()

    async def sleep(delay: float) -> None:
        delays.append(delay)
        if len(delays) == n_delays:
            played.set()
            await asyncio.Event().wait()  # until closed

    link = ReconnectingLink(inner, sleep=sleep, clock=lambda: inner.time, on_change=changes.append)
    await link.open()
    reading = asyncio.ensure_future(_data(link))
    async with asyncio.timeout(PATIENCE_S):
        await played.wait()
        await link.close()
        data = await reading
    assert not inner.is_open
    return data, delays, changes


async def _data(link: Link) -> list[bytes]:
    return [chunk.data async for chunk in link]


async def test_delays_double_to_the_longest_and_start_anew_after_success():
    data, delays, _ = await run([*["absent"] * 7, [b"a"], *["absent"] * 2], 10)
    assert data == [b"a"]
    assert delays == [0.1, 0.2, 0.4, 0.5, 0.5, 0.5, 0.5, 0.1, 0.2, 0.4]


async def test_opening_without_a_chunk_is_no_success():
    _, delays, _ = await run([[], [], [], []], 4)
    assert delays == [0.1, 0.2, 0.4, 0.5]


async def test_holding_long_without_a_chunk_is_success():
    _, delays, _ = await run([[], [], [b"long"], []], 4)
    assert delays == [0.1, 0.2, 0.1, 0.2]


async def test_changes_are_told_and_logged_once_each(caplog):
    caplog.set_level(logging.INFO)
    script = ["absent", "absent", "absent", "busy", [b"a"], "absent"]
    _, _, changes = await run(script, 6)
    expected = [
        LinkStatus(CONNECTING),
        LinkStatus(DOWN, "absent"),
        LinkStatus(DOWN, "busy", is_busy=True),
        LinkStatus(UP),
        LinkStatus(DOWN, "pulled"),
        LinkStatus(DOWN, "absent"),
        LinkStatus(CLOSED),
    ]
    assert changes == expected
    assert len(caplog.records) == len(expected)
    assert caplog.messages[1] == "suit: down, trying again: absent"


def test_back_off():
    back_off = BackOff(first=1, longest=3)
    assert [back_off.next_delay() for _ in range(4)] == [1, 2, 3, 3]
    back_off.reset()
    assert back_off.next_delay() == 1


async def test_strict_opening_raises_and_lenient_goes_on():
    strict = ReconnectingLink(ScriptedLink("absent: plug it in"), strict=True)
    with pytest.raises(LinkError, match="absent: plug it in"):
        await strict.open()
    assert strict.state is CLOSED
    with pytest.raises(LinkError, match="not open"):
        await anext(aiter(strict))
    with pytest.raises(LinkBusyError, match="busy: stop the other"):
        await ReconnectingLink(ScriptedLink("busy: stop the other"), strict=True).open()
    lenient = ReconnectingLink(ScriptedLink("absent: plug it in"))
    await lenient.open()
    assert lenient.status == LinkStatus(DOWN, "absent: plug it in")
    with pytest.raises(LinkError, match="suit is down: absent: plug it in"):
        await lenient.write(b"x")
    with pytest.raises(LinkError, match="already open"):
        await lenient.open()
    await lenient.close()
    assert [chunk async for chunk in lenient] == []


async def test_strict_link_survives_losses_after_the_first_opening(until):
    near, far = loopback_pair("suit")
    link = ReconnectingLink(near, strict=True, back_off=BackOff(0.001, 0.001))
    await link.open()
    chunks = aiter(link)
    for losses, word in enumerate((b"one", b"two", b"three")):
        reading = asyncio.ensure_future(anext(chunks))
        await until(lambda losses=losses: (link.state, link.reconnections) == (UP, losses))
        await far.open()
        await far.write(word)
        assert (await reading).data == word
        far.lose("shaken")
    assert link.reconnections == 2
    await link.close()


async def test_closing_ends_an_opening_that_hangs():
    class Hanging(ScriptedLink):
        async def open(self) -> None:
            await asyncio.Event().wait()

    link = ReconnectingLink(Hanging())
    opening = asyncio.ensure_future(link.open())
    await asyncio.sleep(0)
    assert link.state is CONNECTING
    async with asyncio.timeout(PATIENCE_S):
        await link.close()
        await opening
    assert link.state is CLOSED


async def test_cancelled_opening_may_be_repeated():
    near, _ = loopback_pair("suit")
    link = ReconnectingLink(near)
    for n_turns in range(6):  # cancelled before, while and after the link itself was opened
        opening = asyncio.ensure_future(link.open())
        for _ in range(n_turns):
            await asyncio.sleep(0)
        opening.cancel()
        await asyncio.gather(opening, return_exceptions=True)
        await link.close()
        assert link.state is CLOSED
    await link.open()
    assert link.state is UP
    await link.close()


async def test_cancelled_reader_is_cancelled_and_may_read_again():
    near, far = loopback_pair("suit")
    link = ReconnectingLink(near)
    await link.open()
    await far.open()
    reading = asyncio.ensure_future(anext(aiter(link)))
    await asyncio.sleep(0)
    reading.cancel()
    with pytest.raises(asyncio.CancelledError):
        await reading
    await far.write(b"x")
    assert (await anext(aiter(link))).data == b"x"
    await link.close()


async def test_pseudo_terminal_that_comes_back_elsewhere_under_its_name(
    pseudo_terminal, tmp_path, next_chunk, until
):
    path = tmp_path / "usb-receiver"
    changes: list[LinkState] = []
    link = ReconnectingLink(
        SerialLink(str(path), name="suit"),
        back_off=BackOff(0.005, 0.01),
        on_change=lambda status: changes.append(status.state),
    )
    await link.open()
    assert "no such port" in link.status.reason
    chunks = aiter(link)
    held = [pseudo_terminal()]  # so that the numbers differ each time
    for word in (b"first", b"second", b"third"):
        terminal = pseudo_terminal()
        held.append(pseudo_terminal())
        path.symlink_to(terminal.path)
        reading = asyncio.ensure_future(next_chunk(chunks))
        await until(lambda: link.state is UP)
        terminal.write(word)
        assert (await reading).data == word
        await link.write(b"command")
        assert await terminal.read(7) == b"command"
        path.unlink()  # or the next pseudo-terminal of this number, anybody's, is taken for it
        terminal.close()
        waiting = asyncio.ensure_future(anext(chunks))
        await until(lambda: link.state is not UP)
        chunks = aiter(link)
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
    await link.close()
    assert (changes.count(UP), link.reconnections) == (3, 2)


async def test_server_that_goes_and_comes_back(next_chunk, until):
    async def greet(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        writer.write(b"hello")

    writers: list[asyncio.StreamWriter] = []
    server = await asyncio.start_server(greet, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    link = ReconnectingLink(TcpLink("127.0.0.1", port), back_off=BackOff(0.005, 0.01))
    await link.open()
    chunks = aiter(link)
    assert (await next_chunk(chunks)).data == b"hello"
    server.close()
    writers[0].close()
    reading = asyncio.ensure_future(next_chunk(chunks))
    await until(lambda: "refused" in link.status.reason)
    server = await asyncio.start_server(greet, "127.0.0.1", port)
    assert (await reading).data == b"hello"
    assert (link.state, link.reconnections) == (UP, 1)
    await link.close()
    writers[1].close()
    server.close()


@pytest.mark.parametrize(
    ("url", "is_opened_again"),
    [("/dev/null", True), ("recording:///a.mcap?speed=max", False), ("markers:///walk.c3d", False)],
)
def test_only_a_file_that_was_read_to_its_end_is_not_opened_again(url: str, is_opened_again: bool) -> None:
    assert isinstance(kept_open(link_from_url(url)), ReconnectingLink) == is_opened_again
