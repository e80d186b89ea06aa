"""Other people's recordings as recordings of this gateway: wire packets that replay like a live session.

``formats`` reads them (by name, or by what is in the files); ``segment_names`` finds which module sits on
what; ``suits`` makes the suit of it; ``writing`` sends all through the pipeline and keeps both.
"""
