"""Recorded poses in the files that other programs open; one format a file.

``take`` makes what all formats share: a motion at a regular rate without holes, in the world axes and
the length unit that were asked for; what is sent as messages takes its frames as recorded (``message_file``).
A new format is a file with a function ``write`` and its line in ``FORMATS`` of ``formats``.
"""
