"""The command line answers at once: what is slow to import is imported where it is used."""

import subprocess
import sys

import pytest
from typer.core import TyperGroup

from gateway.cli.lazy_commands import load
from gateway.cli.main import _Commands

SLOW_PACKAGES = (
    *("numba", "scipy", "numpy", "pydantic", "aiomqtt", "amqtt", "asyncio", "importlib.metadata"),
    *("scipy.optimize", "scipy.spatial", "scipy.signal", "devices.emulators", "gateway.settings"),
    *("llvmlite", "vqf", "matplotlib", "cv2", "pyarrow", "viser", "mujoco"),
    *("gateway.pipeline", "gateway.service.service", "gateway.sources.suit", "gateway.outputs.connection"),
    *("gateway.reconstruction.whole_body", "gateway.reconstruction.inertial", "gateway.recording.solving"),
)
SOLVERS = {"numba", "llvmlite", "scipy.spatial", "scipy.optimize", "scipy.signal", "vqf"}
"""What only solving calls: modules take it from ``devices.deferred``, kernels import it when called."""
DRAWERS = {"matplotlib", "cv2", "pyarrow", "viser", "mujoco"}
"""What is imported where something is drawn, read or written with it."""
WORKERS = {name for name in SLOW_PACKAGES if name.startswith("gateway.")} - {"gateway.settings"}
"""What does the work of commands: imported in them, not beside them."""


def imported_by(arguments):
    """Which of the slow packages ``mocap-gateway`` with these arguments has imported at its end."""
    code = (
        "import sys\n"
        f"sys.argv = ['mocap-gateway', *{arguments!r}]\n"
        "from gateway.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        f"print('imported:', *[name for name in {SLOW_PACKAGES!r} if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout, done.stdout.splitlines()[-1].split()[1:]


@pytest.mark.parametrize("arguments", [["--help"], ["-h"]])
def test_help_imports_nothing_slow(arguments):
    assert imported_by(arguments)[1] == []


def test_the_version_is_looked_up_and_nothing_else():
    assert imported_by(["--version"])[1] == ["importlib.metadata"]


def test_help_lists_every_command():
    said = imported_by(["--help"])[0]
    assert all(name in said for name in _Commands.lazy)


@pytest.mark.parametrize("command", _Commands.lazy)
def test_help_of_a_command_imports_nothing_that_solves_draws_or_works(command):
    assert not (SOLVERS | DRAWERS | WORKERS) & set(imported_by([command, "--help"])[1])


def test_the_settings_know_methods_and_sources_by_name_alone():
    code = (
        f"import sys, gateway.settings\nprint(*[name for name in {SLOW_PACKAGES!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= {"numpy", "pydantic", "importlib.metadata", "gateway.settings"}


@pytest.mark.parametrize(
    "arguments",
    [["config", "check", "config/gateway.yaml"], ["config", "schema"], ["recordings", "."]],
    ids=" ".join,
)
def test_commands_that_solve_nothing_import_no_solver(arguments):
    assert not (SOLVERS | DRAWERS) & set(imported_by(arguments)[1])


def test_the_service_starts_without_compiler_solvers_and_emulators():
    assert not {"numba", "scipy.optimize", "devices.emulators"} & set(imported_by(["run", "--help"])[1])


@pytest.mark.parametrize("name", _Commands.lazy)
def test_the_list_says_what_the_command_says(name):
    loaded = load(name, _Commands.lazy[name])
    assert loaded.help.split("\n\n")[0].replace("\n", " ") == _Commands.lazy[name].summary
    if not isinstance(loaded, TyperGroup):  # the list shows no example of a group, which has its own
        assert loaded.epilog == _Commands.lazy[name].epilog


def test_an_unknown_command_is_told_the_nearest():
    done = subprocess.run(
        [sys.executable, "-m", "gateway", "demmo"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "demo" in done.stderr
