"""All modules that are heard, whatever source they come from: their clocks, counters and losses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from devices.link import Chunk
from firmware_protocol import (
    FusedSample,
    InertialSample,
    InertialSampleFine,
    LightSample,
    LocalMeasurement,
    PressureSample,
)
from gateway.clocks import (
    ClockTable,
    EstimatedClock,
    LinkBatching,
    ModuleClock,
    RelayBatching,
    SharedClock,
    SharedOffset,
    SynchronisedClocks,
    TableClocks,
    warm_up,
)
from gateway.contract.balances import Balance
from gateway.sources.clock_mode import ClockMode
from gateway.sources.module_rows import MODULE, module_rows
from gateway.sources.statistics import Cause, LinkLosses, ModuleRecord
from gateway.support.rows import Memory, memory_of, part

_NewClock = Callable[[int, LinkBatching, Memory], ModuleClock]
"""Of a module, the batching of its link and the memory of a clock, its clock."""

SAMPLE_KINDS = frozenset(
    packet.KIND
    for packet in (
        InertialSample,
        InertialSampleFine,
        FusedSample,
        LocalMeasurement,
        LightSample,
        PressureSample,
    )
)
"""Of packets that readings are made from."""


class ModuleTable:
    """One record a module, made when it is first heard. Sans-I/O and deterministic.

    A source of modules announces its links, reports every chunk before its samples, then asks for the time
    of each sample and counts its number.
    """

    def __init__(
        self,
        clock_mode: ClockMode = ClockMode.ESTIMATED,
        clock_table: ClockTable | None = None,
        *,
        is_compiled: bool = True,
    ) -> None:
        """Begin without modules.

        clock_table: rates, for mode TABLE only.
        is_compiled: whether kernels take the usual samples; if not, Python takes all, to the same result.
        """
        self.records: dict[int, ModuleRecord] = {}
        """By module id."""
        self._restarted: set[int] = set()
        """Modules whose clocks have begun anew, ever."""
        self._losses: dict[str, LinkLosses] = {}
        self._batching: dict[str, LinkBatching] = {}
        self._relays: dict[str, RelayBatching] = {}
        self.rows = module_rows()
        """What compiled code shares of them, by module id."""
        self.is_followed = is_compiled and clock_mode not in {ClockMode.TABLE, ClockMode.SYNCHRONISED}
        """Whether compiled code may take samples, and knows the clocks."""
        self._new_clock = _clock_factory(clock_mode, clock_table, is_compiled)

    def add_link(self, name: str) -> None:
        """Announce a link, before its first chunk."""
        self._batching[name], self._relays[name] = LinkBatching(), RelayBatching()
        self._losses[name] = LinkLosses()

    def begin_chunk(self, chunk: Chunk, *, is_trusted: bool = True, is_damaged: bool = False) -> None:
        """Take note of a chunk, before the samples in it.

        is_trusted: False where a stranger sent it, whose time says nothing about the modules. is_damaged:
        something before its samples could not be read.
        """
        if is_trusted:
            self._batching[chunk.link].observe(chunk.arrived_ns)
        self._losses[chunk.link].chunk += 1
        if is_damaged:
            self._losses[chunk.link].notice(Cause.DAMAGED)

    def notice(self, link: str, cause: Cause) -> None:
        """Take note that something was lost on a link since its last chunk: what missing samples fell to."""
        if link in self._losses:
            self._losses[link].notice(cause)

    def losses(self, link: str) -> LinkLosses:
        """Return what befell a link, for ``SequenceCounter.count``."""
        return self._losses[link]

    def relayed(self, link: str, relayed_us: int) -> None:
        """Take note of a batch of a relay, before the samples in it. relayed_us: µs of the relay's clock."""
        self._relays[link].observe_tick(relayed_us)

    def missed(self, link: str, module: int, kind: int, first: int, full: int, received_in: int) -> None:
        """Take note of packets of a kind that have not come: numbers ``first`` up to ``full``, which came.

        received_in: the chunk of the link that held the one before them.
        """
        counter = self.records[module].sequences[kind]
        counter.open_gap(first, full, self._losses[link].cause_since(received_in))

    def timed(
        self,
        module: int,
        module_time_us: int,
        chunk: Chunk,
        relayed_us: int | None = None,
        clock: ModuleClock | None = None,
    ) -> tuple[ModuleRecord, int]:
        """Return the module's record, and an instant of its clock in gateway time, ns.

        module_time_us: µs, counted by the module; relayed_us: when the relay sent it on, by the relay's
        clock. clock: of a module that brings one of its own, in any mode.
        """
        if relayed_us is not None:
            self.relayed(chunk.link, relayed_us)
        record = self.records.get(module)
        if record is None:
            waits = self._batching if relayed_us is None else self._relays
            memory = memory_of(self.rows, module)
            clock = clock or self._new_clock(module, waits[chunk.link], part(memory, MODULE, "clock"))
            record = ModuleRecord(module, clock, chunk.arrived_ns, memory=memory)
            self.records[module] = record

        restarts = record.clock.restarts
        time_ns = record.clock.gateway_time(module_time_us, chunk.arrived_ns)
        if record.clock.restarts != restarts:
            record.restarted_ns.append(chunk.arrived_ns)
            self._restarted.add(module)
            # A restarted module counts its packets from anew too: that is no gap.
            for restarted in record.sequences.values():
                restarted.restart()
        record.last_arrival_ns = chunk.arrived_ns
        return record, time_ns

    def timed_together(
        self, modules: Iterable[int], leader: int, stamp_us: int, chunk: Chunk
    ) -> tuple[list[ModuleRecord], int]:
        """Return the records of modules that share one clock, and an instant of it in gateway time, ns.

        leader: the module whose clock it is, heard in this chunk or before; stamp_us: see ``timed``.
        """
        # Whether the shared clock restarts shows only by comparing: the leader's stamp may be that of a
        # restart.
        known = self.records.get(leader)
        restarts = 0 if known is None else known.clock.restarts
        led, time_ns = self.timed(leader, stamp_us, chunk)
        found = []
        for module in modules:
            record = self.records.get(module)
            if record is None:
                record = ModuleRecord(
                    module, led.clock, chunk.arrived_ns, memory=memory_of(self.rows, module)
                )
                self.records[module] = record
            elif module != leader and led.clock.restarts != restarts:
                for restarted in record.sequences.values():
                    restarted.restart()
            record.last_arrival_ns = chunk.arrived_ns
            found.append(record)
        return found, time_ns

    def restarts(self) -> dict[int, int]:
        """Return how often each module was found to count from anew."""
        return {module: record.clock.restarts for module, record in self.records.items()}

    def restless(self) -> dict[int, str]:
        """Return what to say of modules whose clocks begin anew again and again, by id."""
        found = ((module, self.records[module].restlessness) for module in sorted(self._restarted))
        return {module: why for module, why in found if why is not None}

    def balances(self) -> Iterator[Balance]:
        """Yield what became of all samples sent; and the share of modules in the packets decoded."""
        # The upper bits of a kind tell streams apart that count by themselves; the lower ones are the
        # packet's.
        of_samples = [
            counter
            for record in self.records.values()
            for kind, counter in record.sequences.items()
            if kind & 0xFF in SAMPLE_KINDS
        ]
        lost = {
            f"lost_{cause.name.lower()}": sum(counter.lost_by[cause] for counter in of_samples)
            for cause in Cause
        }
        received = sum(counter.received for counter in of_samples)
        numbered = sum(counter.numbered for counter in of_samples)
        yield Balance("samples_sent", numbered, {"received": received, **lost})
        parts = {
            "received": sum(record.received for record in self.records.values()),
            "repeated": sum(record.duplicates for record in self.records.values()),
        }
        yield Balance("packets_decoded", 0, parts)

    def statistics(self) -> dict[str, object]:
        """Return counters and clock models of all modules, for the health message."""
        return {str(module): record.summary() for module, record in self.records.items()}


def _clock_factory(mode: ClockMode, table: ClockTable | None, is_compiled: bool) -> _NewClock:
    if mode is ClockMode.SHARED:
        shared = SharedOffset()
        return lambda _module, _batching, memory: SharedClock(shared, memory=memory)
    warm_up()
    if mode is ClockMode.SYNCHRONISED:
        together = SynchronisedClocks()
        return lambda _module, batching, _memory: together.clock(batching)
    if mode is ClockMode.TABLE and table is not None:
        clocks = TableClocks(table, is_compiled=is_compiled)
        return lambda module, batching, _memory: clocks.clock(module, batching)
    return lambda _module, batching, memory: EstimatedClock(batching, memory=memory, is_compiled=is_compiled)
