"""What is asked of modules and relays, over links that something else reads.

``transactions`` knows which command waits for which answer (sans-I/O: time is an argument);
``command_client`` sends them over links and hands answers back. On it stand ``configure`` (finds devices,
changes settings and ids so that nothing is lost), ``device_backup`` (all settings as plain data, and back)
and ``card`` (files of the relay's memory card). ``roster`` is which devices answered, ``setting_values``
their settings by name, ``device_errors`` what can go wrong.

Verbs and settings themselves are declared in ``firmware_protocol``; a new setting needs nothing here.
"""
