"""Observations of one kind put together by instant, and solved.

``registry`` says which stage takes which type of observation; the pipeline asks it and knows none by name.
``stage`` says what one is: ``add`` puts observations together to frames of one instant, ``solve`` makes poses
of them.

- ``modules``: readings of the suit. ``clipping`` (ranges of sensors), then ``frame_assembler`` over
  ``frame_grid`` for raw samples, ``fused_assembler`` for orientations fused on board.
- ``markers``, ``cameras``: their sources give whole instants already.

A new kind of observation is a type in ``gateway/frames.py``, a class in a file here, and its line in
``registry``.
"""
