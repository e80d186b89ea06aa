"""Two results of one motion from different sources: aligned in time and in the world, then compared."""

from gateway.agreement.agreement import Agreement, SegmentAgreement, agreement
from gateway.agreement.tracks import Tracks, tracks_of

__all__ = ["Agreement", "SegmentAgreement", "Tracks", "agreement", "tracks_of"]
