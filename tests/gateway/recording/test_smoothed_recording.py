"""``--smooth``: recordings solved forward and backward, by every command that makes something of one."""

import dataclasses

import numpy as np
import pytest

from gateway.errors import GatewayError
from gateway.recording import open_recording
from gateway.recording.solving import recorded_setup, solve, verify, write_solved


def test_smoothing_what_has_no_covariances_says_what_would_do(record, typed):
    with pytest.raises(GatewayError, match="for the methods joint and outward: add --reconstructor joint"):
        typed("replay", record(), "--smooth")


@pytest.fixture
def by_joint():
    """The setup of a recording, smoothed or not, with the method that can."""

    def setup(recording, smoothed):
        recorded = recorded_setup(recording)
        settings = recorded.settings.model_copy(update={"reconstructor": "joint"})
        return dataclasses.replace(recorded, settings=settings, smoothed=smoothed)

    return setup


class TestSmoothed:
    def test_the_result_is_a_recording_like_any_other(self, record, by_joint, tmp_path):
        recording, target = open_recording(record()), tmp_path / "smoothed.mcap"
        told = []
        count = write_solved(
            recording, target, by_joint(recording, True), lambda done, total: told.append(done / total)
        )
        result = open_recording(target)
        assert result.meta.smoothed
        assert not recording.meta.smoothed
        assert verify(result).is_identical
        assert list(result.chunks()) == list(recording.chunks())
        arrays, forward = result.skeleton_arrays(), list(solve(recording, by_joint(recording, False)))
        assert len(arrays.time_ns) == count == len(forward)
        np.testing.assert_array_equal(arrays.time_ns, [frame.time_ns for frame in forward])
        assert not np.array_equal(arrays.q_wb, np.stack([frame.q_wb for frame in forward]))
        assert told == sorted(told)
        assert told[-1] == 1.0

    def test_by_command(self, record, typed, tmp_path):
        path = record()
        assert typed("replay", path, "--reconstructor", "joint", "--smooth")[0] == 0
        smoothed = path.with_name(f"{path.stem}_joint_smoothed.mcap")
        assert open_recording(smoothed).meta.smoothed
        written, again = tmp_path / "a.csv", tmp_path / "b.csv"
        code, told = typed("export", smoothed, "--to", "csv", "-o", written, "--json")
        assert (code, told[0]["frames"] > 100) == (0, True)
        assert typed("export", smoothed, "--to", "csv", "-o", again, "--smooth")[0] == 0
        assert written.read_bytes() == again.read_bytes()

    def test_every_recording_of_a_folder(self, record, typed, tmp_path):
        folder, results = record().parent, tmp_path / "results"
        asked = ("batch", folder, "--to", "mcap", "--reconstructor", "joint", "--smooth", "--workers", 1)
        code, told = typed(*asked, "-o", results, "--json")
        assert (code, told["done"], told["failed"]) == (0, 1, {})
        (made,) = results.glob("*.mcap")
        assert open_recording(made).meta.smoothed

    def test_a_method_that_cannot_is_refused_before_anything_is_written(self, record, by_joint, tmp_path):
        recording = open_recording(record())
        setup = dataclasses.replace(recorded_setup(recording), smoothed=True)
        with pytest.raises(GatewayError, match="smoothing is for"):
            write_solved(recording, tmp_path / "x.mcap", setup)
        assert not (tmp_path / "x.mcap").exists()
