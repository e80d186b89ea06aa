"""Links: how bytes come to this computer and leave it. ``devices.endpoints`` makes any of them from a string.

What a link is stands in ``devices.link``. Each file opens, reads, stamps, writes and closes one kind of port:

- byte streams: ``serial_link`` (with ``serial_ports``: which there are, who holds one), ``rfc2217_link``,
  ``tcp_link``, ``udp_link`` (what listens shares ``listening``), ``signed_link`` around either;
- CAN frame records: ``socketcan_link``, ``can_link``, ``slcan_link`` (with the text codec ``slcan``);
- markers of an optical system: ``marker_file_link``, ``qtm_link``.

What they share: ``arrivals`` is the one queue between a receive callback and the reader, ``reader_thread``
fills it where a library can only block, ``link_counts`` is what became of every byte, and ``reconnect`` keeps
any live link open for ever.

A new transport is a class with the members of ``devices.link.Link`` in a file here, and a scheme in
``devices/endpoints.py``.
"""
