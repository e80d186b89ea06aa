"""Serial links on real pseudo-terminals."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import grp
import os
import struct
import subprocess
import sys
import termios

import pytest

from devices.link import Framing, LinkBusyError, LinkError
from devices.links import serial_ports
from devices.links.serial_link import SerialLink
from tests.patience import PATIENCE_S

EVERY_BYTE = bytes(range(256))


@pytest.fixture
async def joined(pseudo_terminal):
    terminal = pseudo_terminal()
    link = SerialLink(terminal.path, name="suit")
    await link.open()
    yield terminal, link
    await link.close()


async def test_every_byte_passes_both_ways(joined, read_bytes):
    terminal, link = joined
    assert link.framing is Framing.BYTE_STREAM
    terminal.write(EVERY_BYTE * 8)
    assert await read_bytes(link, 2048) == EVERY_BYTE * 8
    await link.write(EVERY_BYTE * 8)
    assert await terminal.read(2048) == EVERY_BYTE * 8


async def test_arrival_is_stamped_before_a_busy_reader_looks(joined, stamped_on_arrival):
    terminal, link = joined
    await stamped_on_arrival(link, lambda: terminal.write(b"x"))


async def test_large_write_waits_without_blocking_the_loop(joined):
    terminal, link = joined
    data = os.urandom(200_000)
    writing = asyncio.ensure_future(link.write(data))
    await asyncio.sleep(0.02)
    assert not writing.done()  # far more than the terminal's buffer
    assert await terminal.read(len(data)) == data
    await writing


async def test_concurrent_writes_do_not_mix(joined):
    terminal, link = joined
    parts = [bytes([letter]) * 30_000 for letter in b"abc"]
    writing = asyncio.gather(*(link.write(part) for part in parts))
    assert await terminal.read(90_000) == b"".join(parts)
    await writing


async def test_hang_up_gives_what_came_then_the_loss(joined, read_bytes, until):
    terminal, link = joined
    terminal.write(b"last words")
    await until(lambda: link.counts.waiting == 10)
    terminal.close()
    assert await read_bytes(link, 10) == b"last words"
    with pytest.raises(LinkError, match=r"was lost .*unplugged or switched off"):
        await read_bytes(link, 1)
    with pytest.raises(LinkError, match="was lost"):
        await link.write(b"x")


async def test_hang_up_ends_a_write_that_waits(joined):
    terminal, link = joined
    writing = asyncio.ensure_future(link.write(bytes(200_000)))
    await asyncio.sleep(0.01)
    terminal.close()
    with pytest.raises(LinkError, match="was lost"):
        await asyncio.wait_for(writing, PATIENCE_S)


async def test_closing_ends_iteration_and_a_write_that_waits(joined):
    _, link = joined
    reading = asyncio.ensure_future(anext(aiter(link), None))
    writing = asyncio.ensure_future(link.write(bytes(200_000)))
    await asyncio.sleep(0.01)
    await link.close()
    assert await asyncio.wait_for(reading, PATIENCE_S) is None
    with pytest.raises(LinkError, match="closed while writing"):
        await asyncio.wait_for(writing, PATIENCE_S)
    with pytest.raises(LinkError, match="suit is closed"):
        await link.write(b"x")


async def test_symlink_is_resolved_at_every_open(pseudo_terminal, tmp_path, read_bytes):
    path = tmp_path / "usb-receiver"
    link = SerialLink(str(path))
    for word in (b"first", b"second"):
        terminal = pseudo_terminal()
        path.unlink(missing_ok=True)
        path.symlink_to(terminal.path)
        await link.open()
        terminal.write(word)
        assert await read_bytes(link, len(word)) == word
        await link.close()
        terminal.close()


def waiting_on(descriptor):
    """Bytes that the kernel holds for whoever reads."""
    count = bytearray(4)
    fcntl.ioctl(descriptor, termios.FIONREAD, count)
    return int.from_bytes(count, sys.byteorder)


async def test_what_waited_before_opening_is_discarded(pseudo_terminal, read_bytes, until):
    terminal = pseudo_terminal()
    held = os.open(terminal.path, os.O_RDWR | os.O_NOCTTY)
    terminal.write(b"stale")
    await until(lambda: waiting_on(held) == 5)
    link = SerialLink(terminal.path)
    await link.open()
    terminal.write(b"fresh")
    assert await read_bytes(link, 5) == b"fresh"
    await link.close()
    os.close(held)


@pytest.mark.parametrize("baud", [115_200, 1_000_000, 1_234_567])
async def test_any_baud_rate_is_set(pseudo_terminal, baud):
    terminal = pseudo_terminal()
    link = SerialLink(terminal.path, baud=baud)
    await link.open()
    settings = bytearray(44)
    fcntl.ioctl(terminal.master, 0x802C542A, settings)  # TCGETS2 of the pair
    assert struct.unpack_from("<II", settings, 36) == (baud, baud)
    lflag = struct.unpack_from("<I", settings, 12)[0]
    assert not lflag & (termios.ECHO | termios.ICANON)
    await link.close()


async def test_second_opening_in_this_process_is_refused(joined):
    terminal, link = joined
    with pytest.raises(LinkBusyError, match=rf"{terminal.path} is busy: this very process has it open"):
        await SerialLink(terminal.path).open()
    with pytest.raises(LinkError, match="suit is already open"):
        await link.open()


async def test_busy_port_names_the_process_that_holds_it(pseudo_terminal):
    terminal = pseudo_terminal()
    program = "import fcntl,sys;f=open(sys.argv[1]);fcntl.flock(f,2);print(flush=True);sys.stdin.read()"
    with subprocess.Popen(  # noqa: ASYNC220 - the test waits for it anyway
        [sys.executable, "-S", "-c", program, terminal.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        with pytest.raises(LinkBusyError, match=rf"is busy: python\S* \(process {holder.pid}\) has it open"):
            await SerialLink(terminal.path).open()
        holder.communicate()
    link = SerialLink(terminal.path)
    await link.open()
    await link.close()


async def test_absent_port_lists_those_present_by_id_first(tmp_path, monkeypatch):
    (tmp_path / "usb-Receiver-if00").symlink_to("/dev/null")
    monkeypatch.setattr(serial_ports, "BY_ID", tmp_path)
    monkeypatch.setattr(serial_ports.list_ports, "comports", list)
    with pytest.raises(LinkError) as caught:
        await SerialLink("/dev/ttyUSB77").open()
    assert str(caught.value) == (f"/dev/ttyUSB77: no such port; ports present: {tmp_path}/usb-Receiver-if00")
    monkeypatch.setattr(serial_ports, "BY_ID", tmp_path / "none")
    with pytest.raises(LinkError, match="no serial port is present: plug the receiver in"):
        await SerialLink("/dev/ttyUSB77").open()


def test_a_port_is_listed_once_under_its_stable_name(tmp_path, monkeypatch):
    class Port:
        def __init__(self, device: str) -> None:
            self.device = device

    (tmp_path / "usb-B").symlink_to("/dev/null")
    monkeypatch.setattr(serial_ports, "BY_ID", tmp_path)
    monkeypatch.setattr(serial_ports.list_ports, "comports", lambda: [Port("/dev/ttyS1"), Port("/dev/null")])
    assert serial_ports.serial_ports() == [f"{tmp_path}/usb-B", "/dev/ttyS1"]


async def test_dangling_symlink_says_where_it_points(tmp_path):
    path = tmp_path / "suit"
    path.symlink_to("/dev/pts/99999")
    with pytest.raises(LinkError, match="points to /dev/pts/99999, which is not there"):
        await SerialLink(str(path)).open()


@pytest.mark.parametrize("path", ["/dev/null", "/tmp", __file__])
async def test_what_is_no_terminal_is_refused(path):
    with pytest.raises(LinkError, match="is not a serial port"):
        await SerialLink(path).open()


def test_forbidden_port_names_the_group_and_the_command(tmp_path):
    port = tmp_path / "ttyUSB0"
    port.touch()
    groups = {group.gr_name: group.gr_gid for group in grp.getgrall()}
    if os.geteuid() != 0 or "dialout" not in groups:
        pytest.skip("only root can give a file to the group dialout, which must exist")
    os.chown(port, -1, groups["dialout"])
    error = serial_ports.open_error(str(port), PermissionError(errno.EACCES, "Permission denied"))
    assert str(error) == (
        f"{port}: no permission; it belongs to group dialout: "
        "run 'sudo usermod -aG dialout $USER' and log in again"
    )


async def test_reading_before_opening_is_refused():
    with pytest.raises(LinkError, match="not open"):
        await anext(aiter(SerialLink("/dev/ttyUSB0")))
