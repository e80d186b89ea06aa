"""``calibrate clocks`` as a user types it, on an emulated suit, and the table it writes in use."""

import pytest
import yaml

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import Imperfections
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from devices.link import Chunk, Framing
from devices.recording_writer import RecordingWriter, session_record
from gateway.body.rig import load_rig
from gateway.clocks import load_clock_table
from gateway.emulation.rig import dress, move
from gateway.errors import SettingsError
from gateway.pipeline import Pipeline
from gateway.settings import load_gateway_settings
from tests.running_suit import running
from tests.typed_here import typed_here

pytestmark = pytest.mark.system

CLOCKS = Imperfections(
    clock_skew_ppm=3000.0, has_random_clock_start=True, has_random_phase=True, latency=0.001, jitter=0.0005
)


def emulated_traffic():
    suit = load_rig("robot_arm_4")
    motion = move(dress(suit), suit.skeleton.name, seed=5)
    return suit, SuitTraffic(motion, SuitSettings(), CLOCKS, seed=5)


def write_config(folder, **changes):
    settings = {"links": [{"name": "suit", "url": str(folder / "suit")}], "rig": "robot_arm_4"} | changes
    (folder / "gateway.yaml").write_text(yaml.safe_dump(settings))
    return folder / "gateway.yaml"


def recorded(path, traffic, seconds):
    """Write what a suit sends in so many seconds, as a gateway that is never late would have recorded it."""
    with RecordingWriter(path, session_record({"suit": Framing.BYTE_STREAM}), {}, 0) as writer:
        for sent in traffic.transmissions(seconds):
            chunk = Chunk(sent.data, round(sent.time_s * 1e9), "suit")
            writer.add_chunk(chunk, Framing.BYTE_STREAM)


def test_the_table_has_the_emulated_rates_and_the_pipeline_takes_it(tmp_path):
    suit, traffic = emulated_traffic()
    recorded(tmp_path / "lying.mcap", traffic, 30.0)
    url = f"recording://{tmp_path / 'lying.mcap'}?speed=max"
    config = write_config(tmp_path, links=[{"name": "suit", "url": url}])
    shortened = ["--minutes", 2, "--minute-s", 10, "--settling-s", 3]
    code, output, errors = typed_here(["calibrate", "clocks", "-c", config, *shortened])
    assert code == 0, errors
    assert "robot_arm_4.clocks.yaml" in output
    table = load_clock_table(tmp_path / "robot_arm_4.clocks.yaml")
    skews = {i: 1e6 * traffic.senders[i].clock.skew for i in suit.module_ids}
    assert list(table.ranking) == sorted(skews, key=skews.__getitem__)  # slowest first
    for module, skew in skews.items():
        assert table.skew_ppm(module) == pytest.approx(skew - skews[table.reference], abs=30)

    settings = load_gateway_settings(
        write_config(
            tmp_path, clock={"mode": "table", "table": "robot_arm_4.clocks.yaml"}, assembly={"despike": True}
        )
    )
    pipeline = Pipeline.from_settings(settings, suit)
    pipeline.add_link("suit", Framing.BYTE_STREAM)
    _, again = emulated_traffic()
    frames = []
    for sent in again.transmissions(4.0):
        frames += pipeline.feed(Chunk(sent.data, round(sent.time_s * 1e9), "suit"))
    assert len(frames) > 350
    modules = pipeline.statistics()["modules"]
    assert set(modules) == {
        str(i) for i in (*suit.module_ids, *(d.device for d in suit.local_devices if d.device))
    }
    assert {"offset_ns", "clock_ppm", "residual_us", "restarts", "lost", "gaps"} <= set(modules["1"])


async def test_modules_on_a_port_are_measured_in_real_time(command, tmp_path):
    config = write_config(tmp_path)
    suit, traffic = emulated_traffic()
    emulated = EmulatedSuit(traffic.transmissions(3600.0), PtyTransport(tmp_path / "suit"))
    async with running(emulated):
        shortened = ("--minutes", 1, "--minute-s", 1, "--settling-s", 0.5)
        process = command("calibrate", "clocks", "-c", config, *shortened)
        assert await process.ended() == 0, process.report()
    table = load_clock_table(tmp_path / "robot_arm_4.clocks.yaml")
    assert set(table.ranking) == set(suit.module_ids)


@pytest.mark.parametrize(
    ("output", "told"),
    [
        (["-o", "no/such/table.yaml"], "there is no folder"),
        (["-o", "gateway.yaml"], "gateway.yaml exists: name another file with --output, or replace it"),
        ([], "robot_arm_4.clocks.yaml exists: name another file"),
    ],
)
def test_what_cannot_be_measured_is_one_line(tmp_path, monkeypatch, output, told):
    monkeypatch.chdir(tmp_path)
    config = write_config(tmp_path)
    (tmp_path / "robot_arm_4.clocks.yaml").touch()
    code, _, error = typed_here(["calibrate", "clocks", "-c", config, *output])
    assert code == 1
    assert told in error
    assert len(error.strip().splitlines()) == 1


@pytest.mark.parametrize("clock", [{"mode": "table"}, {"mode": "estimated", "table": "x.yaml"}])
def test_a_table_and_its_mode_go_together(tmp_path, clock):
    with pytest.raises(SettingsError, match="mode 'table' needs"):
        load_gateway_settings(write_config(tmp_path, clock=clock))
