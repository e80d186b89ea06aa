"""A defect of the pipeline costs a chunk and a line in the log, not the session."""

from __future__ import annotations

import logging

from devices.link import Chunk
from gateway.body.rig import load_rig
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings


def test_a_chunk_that_cannot_be_handled_is_told_and_counted(monkeypatch, caplog):
    settings = GatewaySettings(links=[LinkSettings(name="suit", url="/dev/null")], rig="arm_3")
    service = Service(settings, load_rig("arm_3"))

    def fails(_chunk: Chunk) -> list[object]:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(service.pipeline, "feed", fails)
    caplog.set_level(logging.ERROR)
    for index in range(12):
        assert service._fed(Chunk(b"abc", index, "suit")) == []
    assert service.failed_chunks == service.statistics()["failed_chunks"] == 12
    # The first and the tenth: a link at 1000 chunks a second must not fill the log.
    assert len(caplog.records) == 2
    assert "3 bytes of suit at 0 ns" in caplog.messages[0]
    assert caplog.records[0].exc_info is not None
