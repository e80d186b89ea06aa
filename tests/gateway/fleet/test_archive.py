"""The archive: recordings and streams in, queries out, solved again to the same bytes, a wearer forgotten."""

from __future__ import annotations

import asyncio
import errno
import os
import shutil
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson
import psutil
import pytest

pytest.importorskip("pyarrow.parquet")
pytest.importorskip("duckdb")

from gateway.contract.messages import BridgeInfo, UtcAnchor
from gateway.errors import GatewayError
from gateway.fleet import solving
from gateway.fleet.archive import Archive, ArchiveError, Partition
from gateway.fleet.collecting import Collector
from gateway.fleet.overview import listener
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import LateSettings, MqttSettings
from gateway.recording import open_recording

if TYPE_CHECKING:
    from tests.fixtures.brokers import Mosquitto
    from tests.fixtures.poses import PoseSource

CAPTURES = Path(__file__).parents[2] / "golden" / "captures"
DAY_NS = 86_400_000_000_000


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    return Archive(tmp_path / "archive", is_new=True)


class Sent:
    """A message as aiomqtt gives it."""

    def __init__(self, topic: str, payload: bytes) -> None:
        self.topic = type("Topic", (), {"value": topic})
        self.payload = payload
        self.retain = False


def info(instance: str = "i1") -> bytes:
    anchor = UtcAnchor(t_ns=0, utc_ns=DAY_NS, offset_ns=DAY_NS, steps=0)
    told = BridgeInfo(
        version="1", gateway="g", reconstructor="joint", frame_rate=10, instance=instance, utc=anchor
    )
    return told.payload()


def pose(seq: int, knee: float = 10.0, **more: object) -> bytes:
    told = {
        "t_ns": seq * 100_000_000,
        "seq": seq,
        "segments": {"pelvis": [1.0, 0.0, 0.0, 0.0], "left_foot": None},
        "joint_angles": {"right_knee": {"flexion": knee}},
        **more,
    }
    return orjson.dumps(told)


def collected(archive: Archive, *sent: tuple[str, bytes]) -> Collector:
    collector = Collector(archive, "ward2", "mocap", {"g": "anna"})
    for topic, payload in sent:
        collector.take(Sent(f"mocap/{topic}", payload))  # type: ignore[arg-type]
    collector.flush()
    archive.renew_catalogue()
    return collector


def rows(archive: Archive, sql: str) -> list[tuple[object, ...]]:
    return list(archive.query(sql)[1])


def test_live_and_late_poses_are_kept_once_with_their_angles(archive: Archive):
    late = [("g/pose/late", pose(seq, instance="i1", sent_ns=1)) for seq in range(3, 8)]
    collector = collected(
        archive, ("g/bridge/info", info()), *(("g/pose", pose(seq, 10.0 * seq)) for seq in range(5)), *late
    )
    assert (collector.rows, collector.repeated, collector.undecodable) == (8, 2, 0)
    assert rows(archive, "SELECT count(*), count(DISTINCT seq), sum(late::INT) FROM poses") == [(8, 8, 3)]
    above = "SELECT DISTINCT wearer, day::VARCHAR FROM poses WHERE right_knee_flexion_deg > 35"
    assert rows(archive, above) == [(archive.pseudonym("anna"), "1970-01-02")]
    assert rows(archive, "SELECT rows, method, site FROM catalogue") == [(8, "joint", "ward2")]


def test_a_collector_that_begins_anew_takes_nothing_twice(archive: Archive):
    said = [("g/bridge/info", info()), *(("g/pose", pose(seq)) for seq in range(5))]
    collected(archive, *said)
    again = collected(archive, *said, ("g/pose", pose(5)))
    assert (again.rows, again.repeated) == (1, 5)
    restarted = collected(archive, ("g/bridge/info", info("i2")), ("g/pose", pose(0)))
    assert restarted.rows == 1  # a gateway that was started again counts from the beginning


@pytest.mark.parametrize(
    "payload",
    [
        b"{",
        b"[]",
        b'{"seq":1}',
        pose(1, segments=5),
        pose(1, segments={"pelvis": [1.0, 0.0]}),
        pose(1, segments={"pelvis": ["x", 0.0, 0.0, 0.0]}),
        pose(1, t_ns=2**62 * 3),
        pose(1, t_ns=1e300),
        pose(1, joint_angles={"right_knee": {"flexion": "much"}}),
    ],
)
def test_what_is_no_pose_is_counted_and_holds_up_no_other(archive: Archive, payload: bytes):
    sent = [("g/bridge/info", info()), ("g/pose", payload), ("g/pose", pose(2))]
    collector = collected(archive, *sent)
    assert (collector.undecodable, collector.rows) == (1, 1)


def test_a_method_that_would_lead_out_of_the_archive_is_not_taken(archive: Archive):
    told = orjson.dumps(orjson.loads(info()) | {"reconstructor": "../../../outside"})
    collector = collected(archive, ("g/bridge/info", told), ("g/pose", pose(1)))
    assert (collector.undecodable, collector.rows) == (1, 0)
    with pytest.raises(ArchiveError, match=r"method '\.\./x'"):
        Partition("../x", "ward2", "2026-01-01", "0")
    assert {path.name for path in archive.folder.iterdir()} <= {".key", ".lock", "catalogue.parquet"}


def test_half_a_file_is_told_and_left_out(archive: Archive, caplog: pytest.LogCaptureFixture):
    said = [("g/bridge/info", info()), *(("g/pose", pose(seq)) for seq in range(5))]
    collected(archive, *said)
    (whole,) = archive.poses.rglob("*.parquet")
    half = whole.with_name("stream_half.parquet")
    half.write_bytes(whole.read_bytes()[:-100])
    assert archive.renew_catalogue() == 1
    assert f"{half} is no file of rows" in caplog.text
    with pytest.raises(ArchiveError, match=rf"{half}.*: that file is damaged, delete it"):
        rows(archive, "SELECT count(*) FROM poses")
    assert collected(archive, *said).repeated == 5
    assert archive.forget("anna") == (2, 0)


def test_a_damaged_catalogue_is_made_of_the_files_again(archive: Archive):
    collected(archive, ("g/bridge/info", info()), ("g/pose", pose(1)))
    for damage in (b"PAR1", b""):
        (archive.folder / "catalogue.parquet").write_bytes(damage)
        assert rows(archive, "SELECT rows FROM catalogue") == [(1,)]
    (archive.folder / "catalogue.parquet").unlink()
    assert rows(archive, "SELECT rows FROM catalogue") == [(1,)]


def test_what_cannot_be_written_waits_until_it_can(archive: Archive, monkeypatch: pytest.MonkeyPatch):
    def full(*_arguments: object, **_options: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    collector = Collector(archive, "ward2", "mocap", {"g": "anna"})
    collector.take(Sent("mocap/g/bridge/info", info()))  # type: ignore[arg-type]
    collector.take(Sent("mocap/g/pose", pose(1)))  # type: ignore[arg-type]
    with monkeypatch.context() as broken:
        broken.setattr("pyarrow.parquet.write_table", full)
        with pytest.raises(OSError, match=r"No space left on device: '.*stream_.*\.parquet'"):
            collector.flush()
    assert collector.waiting == 1
    collector.flush()
    assert (collector.waiting, rows(archive, "SELECT seq FROM poses")) == (0, [(1,)])
    assert not list(archive.poses.rglob(".*"))


def test_a_damaged_key_is_told(archive: Archive):
    for text in ("", "not hexadecimal", "00"):
        (archive.folder / ".key").write_text(text)
        with pytest.raises(ArchiveError, match=r"\.key holds no key"):
            Archive(archive.folder)


def test_one_name_is_one_wearer_however_it_is_composed(archive: Archive):
    assert archive.pseudonym("Zo\u00eb") == archive.pseudonym(" Zoe\u0308") != archive.pseudonym("Zoe")
    with pytest.raises(ArchiveError, match="name of a wearer is empty"):
        archive.pseudonym(" ")


def test_nothing_is_left_of_a_wearer_who_is_forgotten(archive: Archive):
    collected(archive, ("g/bridge/info", info()), ("g/pose", pose(1)))
    for wearer, name in (("anna", "walking"), ("ben", "serial")):
        path = CAPTURES / f"{name}.mcap"
        archive.add(open_recording(path), path, "ward2", wearer)
    archive.renew_catalogue()
    assert len(list(archive.traces("anna"))) > 2
    files, left = archive.forget("anna")
    assert (files, left, list(archive.traces("anna"))) == (2, 0, [])
    assert [path.name for path in archive.recordings.rglob("wearer=*")] == [
        f"wearer={archive.pseudonym('ben')}"
    ]


def test_days_before_one_are_deleted(archive: Archive):
    collected(archive, ("g/bridge/info", info()), ("g/pose", pose(1)))
    assert archive.expire("1970-01-02") == 0
    assert archive.expire("1970-01-03") == 1
    assert rows(archive, "SELECT count(*) FROM catalogue") == [(0,)]


def test_pseudonyms_are_of_one_archive_and_their_key_is_its_owners(archive: Archive, tmp_path: Path):
    other = Archive(tmp_path / "other", is_new=True)
    assert archive.pseudonym("anna") == Archive(archive.folder).pseudonym("anna") != other.pseudonym("anna")
    assert stat.S_IMODE((archive.folder / ".key").stat().st_mode) == 0o600


def test_errors_say_what_would_do(archive: Archive, tmp_path: Path):
    with pytest.raises(ArchiveError, match="is no archive: make one"):
        Archive(tmp_path / "nothing")
    with pytest.raises(ArchiveError, match=r"site '\.\./x': letters"):
        Collector(archive, "../x", "mocap", {})
    with pytest.raises(GatewayError, match="no recordings to solve"):
        solving.jobs_of(archive, "joint")
    with pytest.raises(ArchiveError, match="DuckDB: "):
        archive.query("SELECT nothing")


def solved_bytes(archive: Archive) -> dict[str, bytes]:
    folder = archive.poses / "method=independent"
    return {path.name: path.read_bytes() for path in sorted(folder.rglob("*.parquet"))}


@pytest.mark.slow(reason="solves recordings in processes of Dask, three times")
def test_solved_again_it_goes_on_and_gives_the_same_bytes_though_a_worker_is_killed(archive: Archive):
    names = ("serial", "walking", "relay", "trigger", "can", "devices")
    for name in names:
        path = CAPTURES / f"{name}.mcap"
        archive.add(open_recording(path), path, "ward2", name)
    jobs = solving.jobs_of(archive, "independent")
    outcomes: list[solving.SolvedRecording] = []
    solving.run(jobs, outcomes.append)
    assert [each.error for each in outcomes] == [None] * len(names)
    first = solved_bytes(archive)
    assert len(first) == len(names)

    again: list[solving.SolvedRecording] = []
    solving.run(jobs, again.append)
    assert all(each.was_there for each in again)

    shutil.rmtree(archive.poses / "method=independent")
    killed = []

    def kill_one() -> None:
        while not (archive.poses / "method=independent").exists():  # the first is being written
            time.sleep(0.05)
        workers = [
            each for each in psutil.Process().children(True) if "spawn_main" in " ".join(each.cmdline())
        ]
        workers[0].kill()
        killed.append(workers[0].pid)

    killer = threading.Thread(target=kill_one)
    killer.start()
    third: list[solving.SolvedRecording] = []
    solving.run(jobs, third.append, workers=2)
    killer.join()
    assert [each.error for each in third] == [None] * len(names)
    assert killed
    assert solved_bytes(archive) == first


def test_solving_writes_where_it_came_from(archive: Archive):
    path = CAPTURES / "walking.mcap"
    kept, *_ = archive.add(open_recording(path), path, "ward2", "anna")
    outcome = solving.perform(solving.Solving(archive.folder, kept, "independent"))
    assert outcome.error is None
    archive.renew_catalogue()
    told = rows(archive, "SELECT method, solved, rows, length(recording) FROM catalogue")
    assert told == [("independent", "again by independent", outcome.rows, 64)]
    part = archive.part(Partition("independent", "ward2", "1970-01-01", archive.pseudonym("anna")), kept.stem)
    assert part.exists()
    assert solving.perform(solving.Solving(archive.folder, kept, "independent")).was_there


@pytest.mark.system
async def test_poses_from_a_broker_are_kept(
    mosquitto: Mosquitto, pose_source: PoseSource, archive: Archive, tmp_path: Path, until: Callable[..., Any]
) -> None:
    settings = MqttSettings(port=mosquitto.port, late=LateSettings(folder=tmp_path / "late"))
    collector = Collector(archive, "ward2", "mocap", {})
    receiver = listener(MqttSettings(port=mosquitto.port), collector.take)
    listening = asyncio.create_task(receiver.run())
    await receiver.subscribed.wait()
    output = MqttOutput(settings, pose_source.skeleton, pose_source.info())
    output.offer(pose_source.frame(0))
    async with output:
        output.offer(pose_source.frame(1))  # before there is a connection: sent late
        await until(lambda: output.is_connected)
        for seq in range(2, 20):
            output.offer(pose_source.frame(seq))
        await until(lambda: collector.rows == 20)
    listening.cancel()
    collector.flush()
    assert rows(archive, "SELECT count(DISTINCT seq), sum(late::INT) >= 1 FROM poses")[0][1] is True


@pytest.mark.system
@pytest.mark.parametrize("what", ["expire --before 2026-01-01", "forget anna --yes", "solve --method joint"])
def test_two_commands_at_once_are_kept_apart(archive: Archive, command: Any, what: str) -> None:
    path = CAPTURES / "walking.mcap"
    archive.add(open_recording(path), path, "ward2", "anna")
    with archive.locked("add"):
        running = command("fleet", "archive", *what.split(), "--archive", str(archive.folder))
        assert running.wait() == 1
    assert f"`fleet archive add` (process {os.getpid()}) works on {archive.folder}: wait" in running.errors
    assert list(archive.recordings.rglob("*.mcap"))


@pytest.mark.system
def test_a_site_is_collected_for_once_and_nobody_is_forgotten_meanwhile(
    archive: Archive, command: Any, mosquitto: Mosquitto
) -> None:
    folder = str(archive.folder)
    with archive.collecting("ward2"):
        options = ("--archive", folder, "--site", "ward2", "--port", str(mosquitto.port), "--seconds", "2")
        again = command("fleet", "archive", "collect", *options)
        assert again.wait() == 1
        assert "`fleet archive collect --site ward2` (process" in again.errors
        forgetting = command("fleet", "archive", "forget", "anna", "--yes", "--archive", folder)
        assert forgetting.wait() == 1
        assert "collect --site ward2" in forgetting.errors
    assert command("fleet", "archive", "collect", *options).wait() == 0
