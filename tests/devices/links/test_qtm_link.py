"""QTM's stream as a link, against a stand-in written from the published protocol: no QTM is at hand."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.back_off import BackOff
from devices.emulators.qtm_stand_in import FILE_STARTED, Kind, QtmStandIn, packet, parameters
from devices.endpoints import EndpointError, link_from_url
from devices.link import LinkError
from devices.links.qtm_link import DEFAULT_PORT, HEADER, QtmLink, QtmPacketError, marking_of, packets_of
from devices.links.reconnect import LinkState, ReconnectingLink
from devices.marker_files import MarkerTrial
from devices.marker_messages import MarkerMessage, MarkerReceiver
from gateway.sources.link_settings import LinkSettings
from tests.patience import PATIENCE_S

pytest.importorskip("qtm_rt", reason="the extra 'optical' is not installed")
LABELS = ("LASI", "R&D", "C7", "*1")
N_FRAMES = 12


def trial(n_frames: int = N_FRAMES) -> MarkerTrial:
    positions = np.random.default_rng(5).normal(0.0, 1.0, (n_frames, len(LABELS), 3))
    positions[3, 1] = positions[4, 3] = np.nan
    return MarkerTrial("walk", LABELS, 200.0, positions)


@contextlib.asynccontextmanager
async def served(stand_in: QtmStandIn):
    await stand_in.start()
    try:
        yield stand_in
    finally:
        await stand_in.stop()


async def taken(
    link, receiver: MarkerReceiver, n: int, arrived_ns: list[int] | None = None
) -> list[MarkerMessage]:
    """n messages; when their chunks arrived goes to ``arrived_ns``."""
    found: list[MarkerMessage] = []
    async with asyncio.timeout(PATIENCE_S):
        async for chunk in link:
            read = receiver.receive(chunk)
            found += read
            if arrived_ns is not None:
                arrived_ns += [chunk.arrived_ns] * len(read)
            if len(found) >= n:
                break
    return found


async def refusal(stand_in: QtmStandIn, **options) -> str:
    async with served(stand_in):
        with pytest.raises(LinkError) as caught:
            await QtmLink("127.0.0.1", stand_in.port, **options).open()
    return str(caught.value)


async def test_every_frame_comes_with_its_names_its_clock_and_what_is_nameless():
    played = trial()
    arrived_ns: list[int] = []
    async with served(QtmStandIn(played, up="+Y", left_out={5, 6, 9})) as stand_in:
        link, receiver = QtmLink("127.0.0.1", stand_in.port), MarkerReceiver()
        await link.open()
        found = await taken(link, receiver, N_FRAMES - 3, arrived_ns)
        await link.close()
    assert not receiver.dropped
    sent = [frame for frame in range(N_FRAMES) if frame not in {5, 6, 9}]
    assert [message.sequence for message in found] == sent
    assert {message.up for message in found} == {"y"}
    seen_ns = np.array(sent) * 5_000_000  # by the cameras' clock, which is set by its least late arrivals
    since_ns = seen_ns[:, None] - seen_ns
    allowed_ns = (np.array(arrived_ns) - seen_ns) + np.round(200e-6 * since_ns).astype(np.int64)
    offset_ns = np.where(since_ns >= 0, allowed_ns, np.iinfo(np.int64).max).min(axis=1)
    np.testing.assert_allclose([m.time_ns for m in found], seen_ns + offset_ns, rtol=0, atol=100)
    for frame, message in zip(sent, found, strict=True):
        seen = {label: played.positions[frame, i] for i, label in enumerate(LABELS[:3])}
        assert set(message.markers) == {label for label, place in seen.items() if np.isfinite(place).all()}
        for label, place in message.markers.items():
            np.testing.assert_allclose(place, seen[label], atol=1e-6)
        assert len(message.unlabelled) == (frame != 4)
    assert link.counts.summary()["not_sent"] == 3
    assert link.counts.taken == link.counts.handed + link.counts.behind + link.counts.waiting


async def test_what_qtm_refuses_is_one_line_that_says_what_would_do():
    assert "refuses version 1.20: 'Version NOT supported'; write ?version=" in await refusal(
        QtmStandIn(trial(), newest=19)
    )
    said = await refusal(QtmStandIn(None))
    assert "refuses its 3D parameters: 'Parameters not available'; open a measurement" in said


async def test_a_version_that_both_know_is_spoken():
    async with served(QtmStandIn(trial(), newest=19)) as stand_in:
        link = link_from_url(f"qtm://127.0.0.1:{stand_in.port}?version=1.19", name="cameras")
        await link.open()
        assert len(await taken(link, MarkerReceiver(), 2)) == 2
        await link.close()


@pytest.mark.parametrize("sent", [b"HTTP/1.1 400 Bad Request\r\n\r\n", bytes(64), packet(Kind.DATA, b"\x01")])
async def test_another_server_is_told_apart_and_nothing_hangs(sent):
    async def serve(reader, writer):
        writer.write(sent)
        await reader.read()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server, asyncio.timeout(20):
        with pytest.raises(LinkError, match="sent what cannot be read"):
            await QtmLink("127.0.0.1", server.sockets[0].getsockname()[1]).open()


async def test_nobody_there_and_no_client_installed(monkeypatch):
    async with served(QtmStandIn(None)) as stand_in:
        port = stand_in.port
    with pytest.raises(LinkError, match="refused the connection: start what should listen there"):
        await QtmLink("127.0.0.1", port).open()
    monkeypatch.setitem(sys.modules, "qtm_rt", None)
    with pytest.raises(LinkError, match=r"pip install .*\[optical\]"):
        await QtmLink("127.0.0.1", port).open()


async def test_hung_up_on_or_given_another_file_it_comes_again_with_the_names_of_then():
    async with served(QtmStandIn(trial(400))) as stand_in:
        back_off = BackOff(0.01, 0.02)
        link = ReconnectingLink(QtmLink("127.0.0.1", stand_in.port), back_off=back_off)
        receiver = MarkerReceiver()
        await link.open()
        await taken(link, receiver, 3)
        stand_in.hang_up()
        while link.reconnections < 1:
            await taken(link, receiver, 1)
        renamed = trial(400)
        stand_in.trial = MarkerTrial("other", ("A", "B", "*1", "*2"), 200.0, renamed.positions)
        stand_in.send_event(FILE_STARTED)
        while link.reconnections < 2:
            await taken(link, receiver, 1)
        assert set((await taken(link, receiver, 1))[-1].markers) == {"A", "B"}
        await link.close()
    assert link.state is LinkState.CLOSED
    assert not receiver.dropped  # its clock fell back to 0 twice, and was followed


def test_addresses():
    link = link_from_url("qtm://cameras.local")
    assert (link.host, link.port, link.name) == (
        "cameras.local",
        DEFAULT_PORT,
        f"qtm://cameras.local:{DEFAULT_PORT}",
    )
    for url, wrong in (
        ("qtm://", "the host is missing"),
        ("qtm://a?version=2", "a version of the protocol is needed"),
        ("qtm://a?speed=1", "unknown parameter 'speed'"),
    ):
        with pytest.raises(EndpointError, match=wrong):
            link_from_url(url)


def test_such_a_link_carries_markers_and_nothing_else():
    assert LinkSettings(name="cameras", url="qtm://a").carries == "markers"
    assert (
        LinkSettings(name="cameras", url="qtm://a", carries="suit").carries == "markers"
    )  # as once recorded
    with pytest.raises(ValueError, match="qtm:// carries markers and nothing else: leave 'carries' out"):
        LinkSettings(name="cameras", url="qtm://a", carries="gnss")


def test_names_come_out_of_the_parameters_and_bad_ones_are_told():
    found = marking_of(parameters(trial(), "-Z").encode())
    assert (found.labels, found.up) == (("LASI", "R&D", "C7"), None)
    for xml, wrong in ((b"<a/>", "no 3D data"), (b"<a", "no XML"), (b"", "no XML")):
        with pytest.raises(QtmPacketError, match=wrong):
            marking_of(xml)
    bomb = b'<!DOCTYPE a [<!ENTITY b "bbbb">]><The_3D>&b;</The_3D>'
    with pytest.raises(QtmPacketError, match="no XML"):
        marking_of(bomb)


@given(contents=st.lists(st.binary(max_size=40), max_size=6), cuts=st.lists(st.integers(1, 60), min_size=1))
def test_packets_are_whole_however_the_stream_is_cut(contents, cuts):
    stream = b"".join(packet(Kind.COMMAND, content) for content in contents)
    found, rest, at, turn = [], b"", 0, 0
    while at < len(stream):
        step = cuts[turn % len(cuts)]
        packets, rest = packets_of(rest + stream[at : at + step])
        found += packets
        at, turn = at + step, turn + 1
    assert (found, rest) == ([packet(Kind.COMMAND, content) for content in contents], b"")


@given(st.binary(max_size=200))
def test_any_bytes_are_packets_or_one_error(received):
    try:
        packets, rest = packets_of(received)
    except QtmPacketError:
        return
    assert b"".join(packets) + rest == received
    assert all(HEADER.unpack_from(each)[0] == len(each) for each in packets)
    assert len(rest) < struct.calcsize("<II") or HEADER.unpack_from(rest)[0] > len(rest)
