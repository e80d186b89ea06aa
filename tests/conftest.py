"""What tests of several packages share: a broker of their own, and the recordings."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest

from benchmarks.local_broker import free_port
from devices.emulators import EmulatedSuit, Imperfections, SuitSettings, SuitTraffic
from devices.emulators.imperfections import IDEAL
from devices.emulators.transports import Transport
from devices.emulators.transports.loopback_transport import LoopbackTransport
from devices.link import gateway_time_ns
from devices.loopback_link import LoopbackLink, loopback_pair
from gateway.body.rig import load_rig
from gateway.body.skeleton import Skeleton
from gateway.cli.emulated_rig import dress, move
from gateway.frames import SkeletonFrame
from gateway.outputs import BridgeInfo
from gateway.reconstruction.readiness import is_ready
from tests.contract_watch import ContractWatch, assert_kept
from tests.patience import PATIENCE_S

hypothesis.settings.register_profile("busy machine", deadline=None)  # an example may wait its turn for long
hypothesis.settings.load_profile("busy machine")

REPOSITORY = Path(__file__).resolve().parents[1]
_CREATED = (
    "from gateway.body.rig import load_rig; from gateway.reconstruction import create_reconstructor\n"
    "for name in {}: create_reconstructor(name, load_rig('suit_17'), 0.01)\n"
)
KERNELS = (
    (
        _CREATED.format(["independent"]),
        "from gateway.reconstruction.optical.warm_up import warm_up; warm_up()",
    ),
    (
        "from gateway.reconstruction.readiness import make_ready; make_ready('joint')",
        _CREATED.format(["articulated", "gyro_free"]),
    ),
)
"""What takes longest to compile, unless it lies on the disk: twice two lots, half a minute to a minute each.
What all methods have in common comes in the first two, and is there for the others."""


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Before several workers start, these kernels are compiled once, two lots side by side; else each worker
    would compile them all for itself. A run without workers compiles what its tests need."""
    if not getattr(session.config.option, "numprocesses", None) or is_ready("joint"):
        return
    there = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    for lots in KERNELS:
        compiling = [subprocess.Popen([sys.executable, "-c", code], env=there) for code in lots]
        codes = [process.wait() for process in compiling]
        if any(codes):
            pytest.exit("kernels could not be compiled: see above", returncode=1)


@pytest.fixture(scope="session", autouse=True)
def _children_find_the_packages() -> None:
    """Child processes import this working tree, installed or not, and can be interrupted: what a script runs
    in the background ignores that, and so would they."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    inherited = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = str(REPOSITORY) + (f"{os.pathsep}{inherited}" if inherited else "")


class Mosquitto:
    """A mosquitto process on a free port of this machine, with the faults a broker can have."""

    host = "127.0.0.1"
    is_for_gateways_only = True
    """Every message relayed is held against the contract; a test that sends others says False."""

    def __init__(self, program: str, directory: Path) -> None:
        self.port = free_port()
        self._program = program
        self._directory = directory
        self._process: subprocess.Popen[bytes] | None = None
        self._extra = ""

    def configure(self, extra: str) -> None:
        """Use further lines of configuration from the next start on."""
        self._extra = extra

    def start(self) -> None:
        anonymous = "" if "allow_anonymous" in self._extra else "allow_anonymous true"
        lines = (
            f"listener {self.port} {self.host}",
            "set_tcp_nodelay true",
            "persistence false",
            "user root",  # no change of user: the files of the test stay readable
            anonymous,
            self._extra,
        )
        config = self._directory / "mosquitto.conf"
        config.write_text("\n".join(lines) + "\n")
        with (self._directory / "mosquitto.log").open("ab") as log:
            self._process = subprocess.Popen(
                [self._program, "-c", str(config)], stdout=log, stderr=subprocess.STDOUT
            )
        self._await_listener()

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()  # it keeps nothing, and takes 0.1 s for a polite end
            self._process.wait()
            self._process = None

    def restart(self) -> None:
        self.stop()
        self.start()

    def freeze(self) -> None:
        """Stop it from running, without closing anything."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)

    def _await_listener(self) -> None:
        assert self._process is not None
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            try:
                socket.create_connection((self.host, self.port), timeout=1).close()
            except OSError:
                if self._process.poll() is not None:
                    break
                time.sleep(0.01)
            else:
                return
        log = (self._directory / "mosquitto.log").read_text(errors="replace")
        pytest.fail(f"mosquitto did not start on port {self.port}:\n{log}")


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    """A running mosquitto with anonymous access, every message of which is held against the contract.

    Skipped where it is not installed, but not in CI.
    """
    program = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
    if program is None:
        reason = "mosquitto is not installed (Debian: apt-get install mosquitto)"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    broker = Mosquitto(program, tmp_path)
    broker.start()
    watch = ContractWatch(broker.host, broker.port)
    try:
        yield broker
    finally:
        watch.stop()
        broker.stop()
    if broker.is_for_gateways_only:
        assert_kept(watch)


@pytest.fixture
def unused_port() -> int:
    """A TCP port that nobody listens on."""
    return free_port()


async def _until(condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
    async with asyncio.timeout(timeout_s):
        while not condition():
            await asyncio.sleep(0.005)


@pytest.fixture
def until() -> Callable[..., Awaitable[None]]:
    """``await until(condition, timeout_s=PATIENCE_S)``: polls; raises ``TimeoutError``."""
    return _until


class PoseSource:
    """Frames of a chain of segments, as a reconstructor would yield them."""

    def __init__(self, n_segments: int = 17) -> None:
        names = tuple(f"segment_{i}" for i in range(n_segments))
        lengths = np.tile([0.0, -0.4, 0.0], (n_segments, 1))
        self.skeleton = Skeleton("chain", names, np.arange(n_segments) - 1, lengths, lengths)
        self._rng = np.random.default_rng(17)

    def info(self, gateway: str = "lab") -> BridgeInfo:
        return BridgeInfo(version="0", gateway=gateway, reconstructor="inertial", frame_rate=100.0)

    def frame(self, sequence: int, time_ns: int | None = None) -> SkeletonFrame:
        n = self.skeleton.n_segments
        q_wb = self._rng.normal(size=(n, 4))
        q_wb *= np.copysign(1, q_wb[:, :1]) / np.linalg.norm(q_wb, axis=1, keepdims=True)
        return SkeletonFrame(
            sequence=sequence,
            time_ns=gateway_time_ns() if time_ns is None else time_ns,
            q_wb=q_wb,
            angular_rate=self._rng.normal(size=(n, 3)),
            joint_acceleration=self._rng.normal(size=(n, 3)),
            p_w=self._rng.normal(size=(n, 3)),
            sigma=np.full(n, 0.01),
            status=np.zeros(n, dtype=np.uint8),
            root=0,
        )


@pytest.fixture
def pose_source() -> PoseSource:
    """17 segments in a chain, moving at random."""
    return PoseSource()


@pytest.fixture
def large_pose_source() -> PoseSource:
    """So many segments that a few messages fill the buffers of a connection."""
    return PoseSource(1000)


@pytest.fixture(scope="session")
def data_directory() -> Path:
    """Where the recordings are: ``MOCAP_DATA``, or ``shared/data`` beside the repository."""
    given = os.environ.get("MOCAP_DATA")
    directory = Path(given) if given else REPOSITORY.parent / "shared" / "data"
    if not directory.is_dir():
        pytest.skip(f"no recordings: {directory} is absent (set MOCAP_DATA to their directory)")
    return directory


@pytest.fixture(scope="session")
def recording_set(data_directory: Path) -> Callable[[str], Path]:
    """``recording_set("broad")``: the directory of one set; skips the test where it is absent."""

    def find(name: str) -> Path:
        directory = data_directory / name
        if not directory.is_dir():
            pytest.skip(f"no recordings of {name}: {directory} is absent")
        return directory

    return find


@dataclass
class CommandedSuit:
    """An emulated suit that obeys, running in the test's event loop."""

    traffic: SuitTraffic
    suit: EmulatedSuit
    link: LoopbackLink
    """The host's end, where no other transport was given."""

    def unique_id(self, which: int | str) -> bytes:
        """Of the device with this number, or on this segment."""
        return self.traffic.device(which).unique_id

    def ids(self) -> dict[int, int]:
        """What each device really has for an id, by number."""
        return {number: device.module_id for number, device in self.traffic.devices.items()}

    def soon_s(self, delay_s: float = 0.05) -> float:
        """Motion time of a moment to come."""
        return self.suit.motion_time_s(gateway_time_ns()) + delay_s


@pytest.fixture
def commanded_suit() -> Callable[..., Any]:
    """``async with commanded_suit(rig, stored_ids={2: 1}) as suit``: any of ``SuitSettings``."""

    @contextlib.asynccontextmanager
    async def start(
        rig: str = "robot_arm_4",
        transport: Transport | None = None,
        imperfections: Imperfections = IDEAL,
        **settings: Any,
    ) -> AsyncIterator[CommandedSuit]:
        worn = load_rig(rig)
        near, far = loopback_pair("suit")
        motion = move(dress(worn), worn.skeleton.name, 1)
        traffic = SuitTraffic(motion, SuitSettings(**settings), imperfections, 1)
        suit = EmulatedSuit(traffic, transport or LoopbackTransport(far))
        running = asyncio.create_task(suit.run())
        try:
            async with asyncio.timeout(PATIENCE_S):
                while suit.start_ns is None:
                    await asyncio.sleep(0.01)
            yield CommandedSuit(traffic, suit, near)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    return start


@pytest.fixture(scope="session")
def chromium() -> str:
    """The browser's program; skips, with what to install, where it or what drives it cannot run."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no chromium on this machine (apt install chromium)")
    driver = pytest.importorskip("playwright._impl._driver", reason="playwright is not installed")
    node, _ = driver.compute_driver_executable()
    started = subprocess.run([node, "--version"], capture_output=True, text=True, timeout=60, check=False)
    if started.returncode:
        pytest.skip(f"what drives the browser cannot run: {started.stderr.strip()} (apt install libatomic1)")
    return program
