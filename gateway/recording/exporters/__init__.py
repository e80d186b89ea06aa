"""Recorded poses in the files that other programs open; one format a file.

``take`` makes what all formats share: a motion at a regular rate without holes, in the world axes and
the length unit that were asked for. ``FORMATS`` names the formats.
"""
