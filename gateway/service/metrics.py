"""Figures of the running gateway as Prometheus metrics.

Counts that may go down again (a packet counted as lost can still come) are gauges: a counter that falls
looks like a restart.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from gateway.contract.balances import Balance
from gateway.contract.messages import BridgeInfo, ModuleState, OutputCounters, UtcAnchor
from gateway.service.overload import LoadWatch

_MODULE = ("module", "segment")
_PER_MODULE_COUNTERS = {
    "received": "Packets received.",
    "duplicates": "Packets received before.",
    "late": "Samples that came after their frame was made.",
    "resets": "How often the module was found to count its time from anew.",
}
_PER_MODULE_GAUGES = {
    "lost": "Packets lost on the way; goes down when one comes late.",
    "rate_hz": "Samples a second.",
    "battery_percent": "Charge of the battery.",
    "temperature_celsius": "Temperature of the sensors.",
    "rssi_dbm": "Strength of the radio signal.",
}
_CLOCK_GAUGES = {
    "ppm": ("ppm", 1.0, "How much faster than the gateway's the module's clock runs."),
    "offset_ns": ("offset_seconds", 1e-9, "Gateway time minus module time."),
    "residual_us": ("residual_seconds", 1e-6, "Mean delay of arrivals above the least one."),
    "sigma_us": ("sigma_seconds", 1e-6, "Standard deviation of the offset, as estimated."),
    "bound_us": ("bound_seconds", 1e-6, "How far the offset can be off at most (time requests answered)."),
}


@dataclass(frozen=True)
class LinkFigures:
    """One link at one moment."""

    name: str
    is_up: bool
    reconnections: int
    dropped: Mapping[str, int] = field(default_factory=dict)
    """Wire frames dropped, by reason."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """What became of its bytes, and what the system lost before."""


@dataclass(frozen=True)
class GatewayFigures:
    """All that is measured, at one moment."""

    info: BridgeInfo
    links: Sequence[LinkFigures]
    modules: Sequence[ModuleState]
    skeleton_frames: int
    dropped_by_assembly: Mapping[str, int]
    outputs: Mapping[str, OutputCounters]
    connected: Mapping[str, bool]
    """Outputs that hold a connection: whether they do."""
    utc: UtcAnchor | None
    balances: Sequence[Balance] = ()
    load: LoadWatch | None = None


def registry_of(figures: GatewayFigures) -> CollectorRegistry:
    """Return a registry that yields these figures, and those of the process (memory, processor time,
    files)."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Figures(figures))
    ProcessCollector(registry=registry)
    return registry


class _Figures(Collector):
    def __init__(self, figures: GatewayFigures) -> None:
        self._figures = figures

    def collect(self) -> Iterable[Metric]:
        """Yield every metric family, read at this instant; called by the Prometheus library."""
        figures = self._figures
        yield from _gateway(figures)
        yield from _links(figures.links)
        yield from _outputs(figures)
        yield from _modules(figures.modules)
        yield from _balances(figures.balances)
        if figures.load is not None:
            yield from _load(figures.load)


def _gateway(figures: GatewayFigures) -> Iterator[Metric]:
    info = figures.info
    words = {"version": info.version, "gateway": info.gateway, "reconstructor": info.reconstructor}
    yield InfoMetricFamily("mocap_gateway", "What runs.", value=words)
    yield CounterMetricFamily("mocap_skeleton_frames", "Poses reconstructed.", value=figures.skeleton_frames)
    lost = CounterMetricFamily(
        "mocap_assembly_dropped", "Samples, or instants, that never reached a frame.", labels=("reason",)
    )
    for reason, count in figures.dropped_by_assembly.items():
        lost.add_metric((reason,), count)
    yield lost
    if figures.utc is not None:
        offset_s = figures.utc.offset_ns * 1e-9
        yield GaugeMetricFamily("mocap_utc_offset_seconds", "UTC minus gateway time.", value=offset_s)
        steps = figures.utc.steps
        yield CounterMetricFamily("mocap_utc_steps", "How often the host's UTC was set.", value=steps)


def _load(load: LoadWatch) -> Iterator[Metric]:
    text = "What is given up since the machine cannot keep up; 0: nothing."
    yield GaugeMetricFamily("mocap_load_stage", text, value=load.stage)
    yield GaugeMetricFamily("mocap_lag_seconds", "How old what is handled now is.", value=load.lag_s)
    yield CounterMetricFamily("mocap_load_changes", "Stages taken and given back.", value=load.changes)


def _links(links: Sequence[LinkFigures]) -> Iterator[Metric]:
    up = GaugeMetricFamily("mocap_link_up", "Whether the link is open.", labels=("link",))
    again = CounterMetricFamily("mocap_link_reconnections", "How often it came up again.", labels=("link",))
    dropped = CounterMetricFamily("mocap_link_dropped", "Wire frames dropped.", labels=("link", "reason"))
    counts = GaugeMetricFamily(
        "mocap_link_count", "Bytes taken, handed on, dropped; losses of the system.", labels=("link", "what")
    )
    for link in links:
        for what, count in link.counts.items():
            counts.add_metric((link.name, what), count)
        up.add_metric((link.name,), link.is_up)
        again.add_metric((link.name,), link.reconnections)
        for reason, count in link.dropped.items():
            dropped.add_metric((link.name, reason), count)
    yield from (up, again, dropped, counts)


def _outputs(figures: GatewayFigures) -> Iterator[Metric]:
    poses = CounterMetricFamily(
        "mocap_output_poses", "What became of the poses offered.", labels=("output", "result")
    )
    queued = GaugeMetricFamily("mocap_output_queued", "Poses waiting now.", labels=("output",))
    connections = CounterMetricFamily("mocap_output_connections", "Connections made.", labels=("output",))
    for name, counters in figures.outputs.items():
        for result in ("published", "dropped", "thinned"):
            poses.add_metric((name, result), getattr(counters, result))
        queued.add_metric((name,), counters.queued)
        connections.add_metric((name,), counters.connections)
    connected = GaugeMetricFamily("mocap_output_connected", "Whether it is connected.", labels=("output",))
    for name, is_connected in figures.connected.items():
        connected.add_metric((name,), is_connected)
    yield from (poses, queued, connections, connected)


def _modules(modules: Sequence[ModuleState]) -> Iterator[Metric]:
    online = GaugeMetricFamily("mocap_module_online", "Whether the module is heard.", labels=_MODULE)
    gaps = GaugeMetricFamily(
        "mocap_module_gaps", "How often so many packets were lost in a row.", labels=(*_MODULE, "length")
    )
    for module in modules:
        online.add_metric(_labels(module), module.availability == "online")
        for length, count in module.gaps.items():
            gaps.add_metric((*_labels(module), length), count)
    yield from (online, gaps)

    for name, text in _PER_MODULE_COUNTERS.items():
        counter = CounterMetricFamily(f"mocap_module_{name}", text, labels=_MODULE)
        for module in modules:
            counter.add_metric(_labels(module), getattr(module, name))
        yield counter
    for name, text in _PER_MODULE_GAUGES.items():
        yield _gauge(f"mocap_module_{name}", text, [(m, getattr(m, name)) for m in modules])
    for name, (unit, factor, text) in _CLOCK_GAUGES.items():
        values = [(m, None if m.clock is None else getattr(m.clock, name)) for m in modules]
        yield _gauge(f"mocap_module_clock_{unit}", text, values, factor)


def _gauge(
    name: str, text: str, values: Sequence[tuple[ModuleState, float | None]], factor: float = 1.0
) -> Metric:
    """Return a gauge of those modules that have a value."""
    gauge = GaugeMetricFamily(name, text, labels=_MODULE)
    for module, value in values:
        if value is not None:
            gauge.add_metric(_labels(module), value * factor)
    return gauge


def _balances(balances: Sequence[Balance]) -> Iterator[Metric]:
    total = GaugeMetricFamily("mocap_balance_total", "What there was to account for.", labels=("balance",))
    parts = GaugeMetricFamily("mocap_balance", "What became of it.", labels=("balance", "part"))
    rest = GaugeMetricFamily(
        "mocap_unaccounted", "Anything but 0 is a defect of the gateway.", labels=("balance",)
    )
    for balance in balances:
        total.add_metric((balance.name,), balance.total)
        rest.add_metric((balance.name,), balance.unaccounted)
        for part, count in balance.parts.items():
            parts.add_metric((balance.name, part), count)
    yield from (total, parts, rest)


def _labels(module: ModuleState) -> tuple[str, str]:
    return str(module.module), module.segment or ""
