"""The hardware side: links that carry bytes, and what is at the other end of them.

Reading order

- ``link``: what a link is (``Chunk``, ``Link``, ``LinkError``) and the gateway's clock.
- ``endpoints``: ``link_from_url`` makes any of the ``links`` from one string.
- ``link_decoder``: chunks of a link to packets of our modules (``firmware_protocol``).
- ``commands``: what is asked of modules: settings, ids, files of the relay's memory card.
- ``recording_format``, ``recording_writer``, ``recording_file``, ``replay_link``: recordings; one is a
  link like any other.
- ``marker_messages``, ``marker_files``, ``cameras``: what optical systems and cameras send.
- ``vendor_protocols``, ``vendor_formats``: other makers' modules, live and recorded (``recorded_tracks``).
- ``conformance``: does a module keep the rules of our protocol? ``emulators``: suits without hardware.

``calibration``, ``calibration_script`` and ``normal_gait`` are what gateway and emulators must agree on,
since neither imports the other; ``geodesy`` and ``ros_definitions`` are conventions of the world outside.
``back_off``, ``deferred`` (what is slow to import), ``extras`` and ``known_names`` serve all. Nothing here
imports ``gateway``.
"""
