"""What the demo's emulated body did, against what was received of it; and whether the machine kept up."""

from __future__ import annotations

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.emulation.rig import dress, move_about
from gateway.frames import FloatArray
from gateway.geometry.comparison import orientation_error, rmse_deg
from gateway.outputs.subscriber import ReceivedPose
from gateway.sources.stream import Stream

SETTLING_S = 3.0
"""Left out of the error: filters start anywhere."""
SEED = 1
_MOST_LOST = 0.02
"""Share of the samples, beyond what is lost on purpose."""
_LATEST_S = 0.1


class Truth:
    """The emulated body's motion, and what was received of it."""

    def __init__(self, suit: WornSuit) -> None:
        self.segment_names = suit.skeleton.segment_names
        self.start_ns = 0
        self._motion = move_about(dress(suit), suit.skeleton.name, SEED)
        self._times_s: list[float] = []
        self._late_s: list[float] = []
        self._q_wb: list[list[list[float]]] = []

    def add(self, received: ReceivedPose) -> None:
        """Keep a pose."""
        undefined = [float("nan")] * 4
        segments = received.pose.segments
        self._times_s.append((received.pose.t_ns - self.start_ns) * 1e-9)
        self._late_s.append(received.latency_s)
        self._q_wb.append([list(segments[name] or undefined) for name in self.segment_names])

    @property
    def n_poses(self) -> int:
        return len(self._times_s)

    def errors_deg(self) -> FloatArray:
        """RMSE by segment: total, inclination, heading, (n_segments, 3), after settling."""
        times = np.array(self._times_s)
        settled = times > SETTLING_S
        if not settled.any():
            return np.full((len(self.segment_names), 3), np.nan)
        errors = orientation_error(np.array(self._q_wb)[settled], self._motion.state(times[settled]).q_wb)
        return np.stack([rmse_deg(part) for part in errors], axis=-1)

    def busy_note(self, stream: Stream, expected_loss: float) -> str | None:
        """Says so where this machine did not keep up with a suit in real time; None where it did.

        stream: of the gateway; what it never got could not be handed over in time, but for the
        ``expected_loss`` (share) that is emulated.
        """
        lost = sum(record.lost for record in stream.modules.values())
        share = lost / max(1, lost + sum(record.received for record in stream.modules.values()))
        late_s = float(np.percentile(self._late_s, 95)) if self._late_s else 0.0
        if share <= expected_loss + _MOST_LOST and late_s <= _LATEST_S:
            return None
        return (
            f"this machine was too busy for a suit in real time: {share:.0%} of the samples were lost, and "
            f"5 % of the poses came more than {late_s * 1e3:.0f} ms late. The errors tell of that, too: "
            "try again when less else is running"
        )
