"""The reference firmware, built once for all tests of a run."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from devices.emulators.device.firmware_memory import FirmwareMemory
from gateway.outputs import connection
from tests.firmware.machines import BOARDS, MEMORIES, Machine, NotHere, build
from tests.patience import PATIENCE_S


@pytest.fixture(scope="session")
def program_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """``program_of(board)``: the firmware, built; skips, or in CI fails, where that cannot be done."""
    built: dict[str, Path] = {}

    def program(board: str) -> Path:
        if board not in built:
            try:
                built[board] = build(board, tmp_path_factory.mktemp(f"firmware_{board}"))
            except NotHere as missing:
                if os.environ.get("CI") == "true":
                    pytest.fail(str(missing))
                pytest.skip(str(missing))
        return built[board]

    return program


@pytest.fixture
def figure() -> Callable[[str, str], None]:
    """``figure(what, text)``: print what was seen; keep it for the documentation where a folder is named."""

    def show(what: str, text: str) -> None:
        print(f"{what}: {text}")
        if folder := os.environ.get("FIRMWARE_FIGURES"):
            name = re.sub(r"\W+", "_", what)
            (Path(folder) / f"{name}.json").write_text(json.dumps([what, text]))

    return show


@pytest.fixture(params=BOARDS)
def board(request: pytest.FixtureRequest) -> str:
    """Every board that runs here, one after the other."""
    return str(request.param)


@pytest.fixture
def module(program_of: Callable[[str], Path], tmp_path: Path) -> Iterator[Callable[..., Machine]]:
    """``module(board, number, settings={...}, is_on=True)``: a module, switched off in the end."""
    machines: list[Machine] = []

    def make(
        board: str, number: int = 1, *, is_on: bool = True, more: tuple[str, ...] = (), **memory: Any
    ) -> Machine:
        kind = MEMORIES.get(board, FirmwareMemory)
        held = kind.fresh(tmp_path / f"{board}{number}.img", bytes([number] * 12), **memory)
        machine = Machine(program_of(board), held, tmp_path / f"{board}{number}", more)
        machines.append(machine)
        if is_on:
            machine.switch_on()
        return machine

    yield make
    for machine in machines:
        with contextlib.suppress(OSError):
            machine.cut_power()


@pytest.fixture(autouse=True)
def _brokers_are_given_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A broker of a busy machine may be late."""
    monkeypatch.setattr(connection, "TIMEOUT_S", PATIENCE_S)
