"""The wire for firmware: ``mocap_protocol.h``, one C header generated from the declarations.

``parts`` holds what is written by hand (framing, CAN, flash slots), ``structs`` and its neighbours
write what follows from the declarations, ``generate`` joins both. ``example.c`` is a module in ten lines.
"""
