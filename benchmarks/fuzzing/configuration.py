"""Checks of files that people write."""

from __future__ import annotations

from benchmarks.fuzzing.files import in_a_file, refused_or_read
from gateway.body.body_file import load_body
from gateway.body.rig import load_rig
from gateway.body.urdf import import_urdf
from gateway.clocks.table import load_clock_table, save_clock_table
from gateway.imports.segment_names import read_maps
from gateway.settings import load_gateway_settings


def gateway_file(data: bytes) -> None:
    """A configuration is taken whole or refused."""
    path = in_a_file("gateway.yaml", data)
    refused_or_read(lambda: load_gateway_settings(path))


def rig_file(data: bytes) -> None:
    """A rig, on a shipped body."""
    path = in_a_file("rig.yaml", data)
    refused_or_read(lambda: load_rig(str(path)))


def body_file(data: bytes) -> None:
    """A body."""
    path = in_a_file("body.yaml", data)
    refused_or_read(lambda: load_body(str(path)))


def clock_table(data: bytes) -> None:
    """A clock table: every module's rate and time from it, and what is written is what was read."""
    path = in_a_file("clocks.yaml", data)

    def read() -> None:
        table = load_clock_table(path)
        for module in (*table.alpha, 255):
            times = [table.reference_us(module, counted_us) for counted_us in (-1e6, 0.0, 1e7, 1e12)]
            assert times == sorted(times), (module, times)
        for module in table.alpha:
            table.skew_ppm(module)
        save_clock_table(table, path)
        again = load_clock_table(path)
        assert (again.ranking, again.interval_s) == (table.ranking, table.interval_s)

    refused_or_read(read)


def urdf(data: bytes) -> None:
    """A robot's description, as text."""
    text = data.decode("utf-8", errors="replace")
    refused_or_read(lambda: import_urdf(text))


def map_file(data: bytes) -> None:
    """YAML, or XML if it begins so."""
    path = in_a_file("map.xml" if data[:1] == b"<" else "map.yaml", data)
    refused_or_read(lambda: read_maps([str(path)]))
