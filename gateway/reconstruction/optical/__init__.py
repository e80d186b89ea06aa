"""Markers to skeleton. Reading order: ``marker_set``, ``landmarks`` (rules), ``fitting`` (a person's body),
``reconstructor`` (frame by frame), ``kernels`` (the equations), ``published`` (CN1766831A to the letter)."""
