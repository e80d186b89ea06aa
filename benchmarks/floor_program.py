"""The least that anything like the gateway does: read a port, and publish as often and as much.

``python -m benchmarks.floor_program PORT BROKER_PORT RATE_HZ POSE_FILE``. The file holds a pose message that
the gateway published. One like it goes out 100 times a second of the sampling rate; no byte of the port is
decoded but the delimiter that ends each wire frame.
"""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from pathlib import Path

import aiomqtt

from devices.links.serial_link import open_raw_tty

ROOT = "mocap/bench"
OPTIONS = [(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)]
"""Without it a pose waits for the acknowledgement of the one before, up to 40 ms."""


async def main(port: str, broker_port: int, rate_hz: float, pose: str) -> None:
    """Publish until ended. pose: as published; its instant is replaced by that of the wire frame, ns."""
    rest = pose[pose.index(",") :]
    descriptor = open_raw_tty(port, 1_000_000)
    ended: asyncio.Queue[int] = asyncio.Queue()
    will = aiomqtt.Will(f"{ROOT}/bridge/state", '{"state":"offline"}', qos=1, retain=True)
    async with aiomqtt.Client(
        "127.0.0.1", broker_port, will=will, keepalive=5, timeout=2.0, socket_options=OPTIONS
    ) as client:
        await client.publish(f"{ROOT}/bridge/state", '{"state":"online"}', qos=1, retain=True)
        asyncio.get_running_loop().add_reader(
            descriptor, lambda: ended.put_nowait(os.read(descriptor, 65536).count(0))
        )
        frames = 0
        while True:
            for _ in range(await ended.get()):
                if frames % round(rate_hz / 100.0) == 0:
                    t_ns = 10**18 + round(frames * 1e9 / rate_hz)
                    await client.publish(f"{ROOT}/pose", f'{{"t_ns":{t_ns}{rest}')
                frames += 1


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), Path(sys.argv[4]).read_text()))
