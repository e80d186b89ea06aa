"""The hardware side: links that carry bytes, and what is at the other end of them.

Reading order

- ``link``: what a link is (``Chunk``, ``Link``, ``LinkError``) and the gateway's clock.
- ``endpoints``: ``link_from_url`` makes any of the links below from one string.
- ``serial_link`` (with ``raw_tty``, ``serial_ports``), ``rfc2217_link``, ``tcp_link``, ``udp_link``:
  byte streams.
- ``socketcan_link``, ``can_link``, ``slcan_link`` (with the text codec ``slcan``): CAN frame records.
- ``marker_file_link`` over ``marker_files``, ``qtm_link`` (with ``qtm_packets``): markers of an optical
  system, as ``marker_messages``.
- ``replay_link`` over a ``recording_file``: a recording is a link like any other.
- ``reconnect``: keeps any live link open for ever.
- ``arrivals``: the one queue between a receive callback and the reader of a link; ``reader_thread``:
  what fills it where a library can only block.

Nothing here interprets what modules say (that is ``firmware_protocol``), and nothing here imports
``gateway``.
"""
