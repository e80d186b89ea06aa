"""Where an emulated suit's bytes go: pseudo-terminals, CAN buses, sockets, memory.

``offer`` never waits; ``listen`` receives what the host sends. A transport opens, writes, reads and closes;
it knows no packet fields.
"""

from devices.emulators.transports.can_bus_transport import CanBusTransport
from devices.emulators.transports.link_per_device import LinkPerDevice
from devices.emulators.transports.loopback_transport import LoopbackTransport
from devices.emulators.transports.memory_transport import MemoryTransport
from devices.emulators.transports.pty_transport import PtyTransport
from devices.emulators.transports.signed_transport import SignedTcpTransport, SignedUdpTransport
from devices.emulators.transports.slcan_transport import SlcanTransport
from devices.emulators.transports.tcp_transport import TcpTransport
from devices.emulators.transports.transport import DatagramTransport, Transport
from devices.emulators.transports.udp_transport import UdpTransport

__all__ = [
    "CanBusTransport",
    "DatagramTransport",
    "LinkPerDevice",
    "LoopbackTransport",
    "MemoryTransport",
    "PtyTransport",
    "SignedTcpTransport",
    "SignedUdpTransport",
    "SlcanTransport",
    "TcpTransport",
    "Transport",
    "UdpTransport",
]
