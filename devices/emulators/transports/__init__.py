"""Where an emulated suit's bytes go: pseudo-terminals, CAN buses, sockets, memory.

``offer`` never waits. A transport opens, writes and closes; it knows no packet fields.
"""

from devices.emulators.transports.can_bus_transport import CanBusTransport
from devices.emulators.transports.memory_transport import MemoryTransport
from devices.emulators.transports.pty_transport import PtyTransport
from devices.emulators.transports.slcan_transport import SlcanTransport
from devices.emulators.transports.tcp_transport import TcpTransport
from devices.emulators.transports.transport import Transport

__all__ = [
    "CanBusTransport",
    "MemoryTransport",
    "PtyTransport",
    "SlcanTransport",
    "TcpTransport",
    "Transport",
]
