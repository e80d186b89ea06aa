"""A minute of random faults on a running gateway: the short form of `make soak`."""

import shutil

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(240)]


async def test_a_minute_of_faults():
    if shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin") is None:
        pytest.skip("mosquitto is not installed")
    from benchmarks import soak  # noqa: PLC0415 - imports what only slow tests need

    report = await soak.soak(seed=2, seconds=60.0)
    assert soak.complaints(report) == []
    assert len(report["faults"]) >= 5
