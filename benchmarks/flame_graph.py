"""Where a running gateway spends its processor time, as a flame graph.

``python -m benchmarks.flame_graph FILE.svg`` samples ``mocap-gateway run`` with a suit of 17 modules at
100 Hz on a pseudo-terminal, publishing to mosquitto; ``--tree`` names another clone whose gateway is run.
Needs py-spy (``pip install py-spy``), which reads the stacks from outside, and the right to do so.
"""

from __future__ import annotations

import argparse
import asyncio
import html
import shutil
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.latency import METHOD, await_online, begin, environment_of, line_of, process_of, write_config
from devices.emulators.local_broker import mosquitto
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber

N_MODULES, RATE_HZ = 17, 100.0
SECONDS = 40.0
SETTLING_S = 3.0
SAMPLES_HZ = 400
WIDTH, ROW, LETTER = 1200, 17, 6.6
"""Pixels: of the graph, of a function, of a letter."""
_NARROWEST = 0.4
_IDLE = "_worker (concurrent/futures/thread.py"
"""A thread that waits for work, which py-spy takes for busy."""


@dataclass
class Function:
    """A function where it was called from, and how often it was seen there."""

    name: str
    samples: int = 0
    calls: dict[str, Function] = field(default_factory=dict)

    def add(self, stack: list[str], samples: int) -> None:
        """Count a stack, outermost function first."""
        here = self
        here.samples += samples
        for name in stack:
            here = here.calls.setdefault(name, Function(name))
            here.samples += samples

    @property
    def depth(self) -> int:
        """Rows that it takes."""
        return 1 + max((call.depth for call in self.calls.values()), default=0)


def drawn(root: Function, title: str) -> str:
    """Draw an SVG: width is processor time, callers stand below what they call."""
    height = (root.depth + 2) * ROW
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        'font-family="monospace" font-size="11">'
    )
    text = f'<text x="4" y="{ROW - 4}">{html.escape(title)}</text>'
    return "\n".join([head, text, *_boxes(root, root.samples, 0.0, height - ROW), "</svg>\n"])


def _boxes(function: Function, total: int, x: float, y: int) -> Iterator[str]:
    width = WIDTH * function.samples / total
    if width < _NARROWEST:
        return
    name, share = html.escape(function.name), 100.0 * function.samples / total
    hue = zlib.crc32(function.name.encode()) % 60
    label = html.escape(function.name[: int(width / LETTER)]) if width > 4 * LETTER else ""
    yield (
        f'<g><title>{name}: {share:.1f} %</title><rect x="{x:.1f}" y="{y}" width="{width:.1f}" '
        f'height="{ROW - 1}" fill="hsl({hue},70%,70%)"/><text x="{x + 2:.1f}" y="{y + 12}">{label}</text></g>'
    )
    for call in sorted(function.calls.values(), key=lambda each: each.name):
        yield from _boxes(call, total, x, y - ROW)
        x += WIDTH * call.samples / total


def read_stacks(text: str) -> Function:
    """Join stacks as py-spy writes them: functions from the outermost on, a space, how often seen."""
    root = Function("all")
    for line in text.splitlines():
        stack, _, samples = line.rpartition(" ")
        functions = stack.split(";")
        if not functions[-1].startswith(_IDLE):
            root.add(functions, int(samples))
    return root


async def sampled(tree: Path | None, seconds: float) -> tuple[Function, float]:
    """The stacks of a gateway that is busy, and its processor time in per cent of a core."""
    sampler = shutil.which("py-spy")
    if sampler is None:
        raise SystemExit("py-spy is not installed: pip install py-spy")
    with mosquitto() as (broker_port, _), tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        port, stacks = folder / "suit", folder / "stacks"
        config = write_config(folder, port, broker_port, N_MODULES)
        lasts = str(seconds + 2 * SETTLING_S)
        writer = ("-m", "devices.emulators.paced_writer", str(port), str(N_MODULES), str(RATE_HZ), lasts)
        async with process_of(*writer) as suit:
            await line_of(suit)
            async with (
                process_of("-m", "gateway", "run", "-c", str(config), tree=tree) as gateway,
                PoseSubscriber(MqttSettings(port=broker_port), "bench") as poses,
            ):
                await await_online(poses)
                process = begin(suit, gateway)
                await asyncio.sleep(SETTLING_S)
                before_s = sum(process.cpu_times()[:2])
                wanted = ("--format", "raw", "--function", "--duration", f"{seconds:g}")
                where = ("--rate", str(SAMPLES_HZ), "--pid", str(gateway.pid), "--output", str(stacks))
                sampling = await asyncio.create_subprocess_exec(
                    sampler, "record", *wanted, *where, stdout=asyncio.subprocess.DEVNULL
                )
                if await sampling.wait():
                    raise SystemExit("py-spy may not read other processes here")
                cpu_percent = 100.0 * (sum(process.cpu_times()[:2]) - before_s) / seconds
        return read_stacks(stacks.read_text()), cpu_percent


def main() -> None:
    """Sample and draw."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.flame_graph", description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--tree", type=lambda path: Path(path).resolve(), help="a clone whose gateway is run")
    parser.add_argument("--seconds", type=float, default=SECONDS)
    arguments = parser.parse_args()
    tree: Path | None = arguments.tree
    step = f"from gateway.service import readiness; readiness.make_ready({METHOD!r})"
    prepared = [sys.executable, "-c", step]
    subprocess.run(prepared, check=True, cwd=tree, env=environment_of(tree))  # else another method would run
    root, cpu_percent = asyncio.run(sampled(tree, arguments.seconds))
    title = f"gateway, {N_MODULES} × {RATE_HZ:g} Hz, {METHOD}: {cpu_percent:.1f} % of a core while sampled"
    arguments.file.write_text(drawn(root, title), encoding="utf-8")


if __name__ == "__main__":
    main()
