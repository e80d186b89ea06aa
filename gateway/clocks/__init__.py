"""Module time to gateway time. Every module counts its own crystal; poses want one time.

``gateway.sources.module_table`` gives every module a clock of the mode that the configuration names, and
asks it for the gateway time of each stamp. All are ``ModuleClock``s (``module_clock``), and count by
``counter``: 32 bits unwrapped, restarts found.

- ``estimated``: rate and offset while capturing, from arrival times alone. The least delays of its packets
  are followed by ``delay_floor``, whose equations are in ``floor_filter``; ``batching`` finds how a link
  hands over what it has; exchanges (``sync_exchange``) say what arrivals cannot. ``clock_kernels`` does the
  usual packet compiled, on the same state.
- ``SharedClock``, ``synchronised``: modules that count one time, or keep their clocks together by themselves.
- ``table``: mode 1, distributed compensation by rates measured beforehand.
- ``trigger``: mode 2, unified control: the gateway says when to sample, and no clock is asked.
- ``arrival_line``: samples without stamps.

``utc_anchor`` is gateway time against UTC. A further mode is a ``ModuleClock`` here and its line where
``module_table`` chooses among them.

Sans-I/O and deterministic: arrival times are arguments, and gateway time is the host's monotonic clock.
"""

from gateway.clocks.arrival_line import ArrivalClock, ArrivalLine
from gateway.clocks.batching import LinkBatching, RelayBatching
from gateway.clocks.counter import unwrap
from gateway.clocks.delay_floor import warm_up
from gateway.clocks.estimated import EstimatedClock
from gateway.clocks.module_clock import ClockFigures, ModuleClock, SharedClock, SharedOffset
from gateway.clocks.sync_exchange import Exchange, SyncExchanges
from gateway.clocks.synchronised import SynchronisedClock, SynchronisedClocks
from gateway.clocks.table import (
    ClockCalibration,
    ClockTable,
    TableClock,
    TableClocks,
    clock_table,
    load_clock_table,
    save_clock_table,
)
from gateway.clocks.trigger import Trigger, TriggerAnswer, TriggerAnswers, TriggerTimer
from gateway.clocks.utc_anchor import AnchorReading, AnchorWatch

__all__ = [
    "AnchorReading",
    "AnchorWatch",
    "ArrivalClock",
    "ArrivalLine",
    "ClockCalibration",
    "ClockFigures",
    "ClockTable",
    "EstimatedClock",
    "Exchange",
    "LinkBatching",
    "ModuleClock",
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
