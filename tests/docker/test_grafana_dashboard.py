"""The dashboard asks for metrics and labels that the gateway has."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from gateway.contract.messages import BridgeInfo, OutputCounters, UtcAnchor
from gateway.service.metrics import GatewayFigures, registry_of
from gateway.service.overload import LoadWatch

DASHBOARD = json.loads((Path(__file__).parents[2] / "docker/grafana/mocap_gateway.json").read_text())
SCRAPED = {"job", "instance"}
"""Labels that Prometheus adds."""


def known() -> dict[str, set[str]]:
    """Labels of every metric, by the name that Prometheus stores."""
    info = BridgeInfo(version="1", gateway="g", reconstructor="joint", frame_rate=100.0, modules=())
    utc = UtcAnchor.model_construct(offset_ns=0, steps=0)
    outputs = {"mqtt": OutputCounters(published=1, dropped=0, thinned=0, queued=0)}
    figures = GatewayFigures(info, (), (), 7, {}, outputs, {"mqtt": True}, utc, load=LoadWatch())
    families = list(registry_of(figures).collect())
    suffix = {"counter": "_total", "info": "_info"}
    return {each.name + suffix.get(each.type, ""): set(getattr(each, "_labelnames", ())) for each in families}


KNOWN = known()
TARGETS = [
    (panel["title"], target["expr"], target["legendFormat"])
    for panel in DASHBOARD["panels"]
    for target in panel["targets"]
]


@pytest.mark.parametrize(
    ("title", "expression", "legend"), TARGETS, ids=[f"{t[0]}-{t[1][:40]}" for t in TARGETS]
)
def test_every_panel_asks_for_what_there_is(title, expression, legend):
    found = re.findall(r"((?:mocap|process)_\w+)\{([^}]*)\}", expression)
    assert found, title
    for name, selectors in found:
        assert name in KNOWN, f"{title}: there is no metric {name}"
        labels = set(re.findall(r"(\w+)=~?", selectors)) | set(re.findall(r"\{\{(\w+)\}\}", legend))
        assert labels <= KNOWN[name] | SCRAPED, f"{title}: {name} has no such labels"


def test_variables_ask_for_a_metric_that_there_is_and_panels_do_not_overlap():
    queries = [v["query"]["query"] for v in DASHBOARD["templating"]["list"] if v["type"] == "query"]
    for query in queries:
        assert re.search(r"label_values\((\w+)", query).group(1) in KNOWN
    cells = [
        (x, y)
        for grid in (panel["gridPos"] for panel in DASHBOARD["panels"])
        for x in range(grid["x"], grid["x"] + grid["w"])
        for y in range(grid["y"], grid["y"] + grid["h"])
    ]
    assert len(cells) == len(set(cells))
    assert max(x for x, _ in cells) < 24
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])
