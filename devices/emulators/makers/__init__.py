"""Emulated modules that speak other makers' protocols, and obey as these do.

A ``VendorEmulator`` encodes what an emulated module senses in a protocol of ``devices/vendor_protocols``,
and takes its commands; what is sensed is the same as for our own modules. A maker is a file here and its
line in ``registry``, and in ``devices/emulators/faults/makers_campaign.py`` what damages its messages. One
is imported when a module first speaks with it.
"""
