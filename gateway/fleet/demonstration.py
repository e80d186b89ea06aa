"""A whole fleet on this machine: three brokers and light gateways in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from gateway.fleet.cluster import NODES, READER, Cluster, new_passwords
from gateway.fleet.light import LightGateway, LightPlan
from gateway.outputs.settings import LateSettings, MqttSettings

A_PROCESS = 25
"""Most light gateways of one process."""
_STOP_S = 5.0


@dataclass(frozen=True)
class DemonstrationPlan:
    """What a demonstration is to have."""

    gateways: int
    rate_hz: float
    recording: Path | None = None
    keeps_late: bool = True
    is_cuttable: bool = False
    """Whether the network between the brokers can be cut."""


class DemoFleet:
    """Brokers and gateways, ended on leaving. Everything lies in one folder, which the caller removes."""

    def __init__(self, folder: Path, wanted: DemonstrationPlan) -> None:
        """Prepare a demonstration, not started. Raises ``GatewayError`` without the extra."""
        self.names = [f"gw{number:03d}" for number in range(1, wanted.gateways + 1)]
        self._folder = folder
        self._wanted = wanted
        self._passwords = new_passwords(self.names)
        self.cluster = Cluster(folder / "brokers", self._passwords, is_cuttable=wanted.is_cuttable)
        self.processes: list[subprocess.Popen[bytes]] = []

    def settings(self, user: str = READER, first: int = 0) -> MqttSettings:
        """Return how a user reaches the cluster; first: the node that is tried first."""
        here, *others = self.cluster.addresses(first)
        host, _, port = here.rpartition(":")
        late = LateSettings(folder=self._folder / "late")
        return MqttSettings(
            host=host,
            port=int(port),
            failover=tuple(others),
            username=user,
            password_file=self._password_file(user),
            late=late if user != READER and self._wanted.keeps_late else None,
        )

    def _password_file(self, user: str) -> Path:
        file = self._folder / "passwords" / user
        if not file.exists():
            file.parent.mkdir(mode=0o700, exist_ok=True)
            file.touch(mode=0o600)
            file.write_text(self._passwords[user])
        return file

    def __enter__(self) -> Self:
        self.cluster.__enter__()
        gateways = [
            LightGateway(name=name, mqtt=self.settings(name, index % NODES))
            for index, name in enumerate(self.names)
        ]
        try:
            for begin in range(0, len(gateways), A_PROCESS):
                self._start(gateways[begin : begin + A_PROCESS])
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def _start(self, gateways: Sequence[LightGateway]) -> None:
        plan = LightPlan(
            gateways=tuple(gateways), rate_hz=self._wanted.rate_hz, recording=self._wanted.recording
        )
        file = self._folder / f"light_{gateways[0].name}.json"
        file.write_text(plan.model_dump_json())
        tree = str(Path(__file__).parents[2])
        with file.with_suffix(".log").open("wb") as log:
            self.processes.append(
                subprocess.Popen(
                    [sys.executable, "-m", "gateway.fleet.light", str(file)],
                    env=os.environ | {"PYTHONPATH": tree},
                    cwd=self._folder,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
            )

    def trouble(self) -> str | None:
        """Return what a process of light gateways said that ended by itself; None: all run."""
        for process, log in zip(self.processes, sorted(self._folder.glob("light_*.log")), strict=True):
            if process.poll() is not None:
                return log.read_text(errors="replace").strip().rpartition("\n")[2] or "it said nothing"
        return None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self.processes:
            process.terminate()
        for process in self.processes:
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.cluster.__exit__(kind, error, trace)
