"""Module time to gateway time.

Every module counts its own crystal. Reading order: ``counter`` (32 bits, restarts) → ``module_clock`` (what a
clock is; modules that share one) → ``batching``, ``floor_filter``, ``delay_floor``, ``estimated`` (rate and
offset while capturing, from arrival times alone) → ``synchronised`` (modules that keep their clocks together
by themselves) → ``arrival_line`` (samples without stamps) → ``sync_exchange`` (two-way exchanges) →
``table``, ``table_calibration``, ``table_clock``, ``reference_instants`` (mode 1, distributed compensation: a
table measured beforehand) → ``trigger``, ``trigger_answers`` (mode 2, unified control: the gateway says when
to sample) → ``utc_anchor`` (gateway time against UTC).

Sans-I/O and deterministic: arrival times are arguments, and gateway time is the host's monotonic clock.
"""

from gateway.clocks.arrival_line import ArrivalClock, ArrivalLine
from gateway.clocks.batching import LinkBatching, RelayBatching
from gateway.clocks.counter import unwrap
from gateway.clocks.delay_floor import warm_up
from gateway.clocks.estimated import EstimatedClock
from gateway.clocks.module_clock import ClockFigures, ModuleClock, SharedClock, SharedOffset
from gateway.clocks.reference_instants import Datum, ReferenceInstants
from gateway.clocks.sync_exchange import Exchange, SyncExchanges
from gateway.clocks.synchronised import SynchronisedClock, SynchronisedClocks
from gateway.clocks.table import ClockTable, clock_table, load_clock_table, save_clock_table
from gateway.clocks.table_calibration import ClockCalibration
from gateway.clocks.table_clock import TableClock, TableClocks
from gateway.clocks.trigger import Trigger, TriggerTimer
from gateway.clocks.trigger_answers import TriggerAnswer, TriggerAnswers
from gateway.clocks.utc_anchor import AnchorReading, AnchorWatch

__all__ = [
    "AnchorReading",
    "AnchorWatch",
    "ArrivalClock",
    "ArrivalLine",
    "ClockCalibration",
    "ClockFigures",
    "ClockTable",
    "Datum",
    "EstimatedClock",
    "Exchange",
    "LinkBatching",
    "ModuleClock",
    "ReferenceInstants",
    "RelayBatching",
    "SharedClock",
    "SharedOffset",
    "SyncExchanges",
    "SynchronisedClock",
    "SynchronisedClocks",
    "TableClock",
    "TableClocks",
    "Trigger",
    "TriggerAnswer",
    "TriggerAnswers",
    "TriggerTimer",
    "clock_table",
    "load_clock_table",
    "save_clock_table",
    "unwrap",
    "warm_up",
]
