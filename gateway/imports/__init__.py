"""Other people's recordings as recordings of this gateway: wire packets that replay like a live session.

``formats`` reads them (by name, or by what is in the files); ``segment_names`` finds which module sits on
what; ``suits`` makes the suit of it; ``writing`` sends all through the pipeline and keeps both.
"""

from gateway.imports.formats import FORMATS, ReadOptions, detected, read
from gateway.imports.segment_names import mapped_segments
from gateway.imports.suits import Worn, dressed
from gateway.imports.writing import Imported, write_imported

__all__ = [
    "FORMATS",
    "Imported",
    "ReadOptions",
    "Worn",
    "detected",
    "dressed",
    "mapped_segments",
    "read",
    "write_imported",
]
