"""Cameras: pictures from files, folders and devices (``pictures``), and what is said about them.

``heat_map_messages`` come from processes that look at pictures, here or on another computer; ``orders`` tell
them where to look; ``keypoint_files`` are what other programs found. ``opencv`` is imported when first used.
"""
