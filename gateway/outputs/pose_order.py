"""Which of the poses that come live are new. Sans-I/O."""

from __future__ import annotations


class PoseOrder:
    """The order of the live poses of one gateway, by number and instant.

    A broker that was frozen hands on what it had not sent as if it were live, and two connections may bring
    one pose each: such poses are not new. A gateway that was started again counts from the beginning, at
    later instants.
    """

    def __init__(self) -> None:
        self.seq: int | None = None
        """Number of the newest pose."""
        self._t_ns = 0
        self._instance: str | None = None

    def note_instance(self, instance: str | None) -> None:
        """Note which run of the gateway speaks (``bridge/info``): of another one every pose is new, also
        after a restart of its computer, whose clock may have gone back."""
        if instance != self._instance:
            if self._instance is not None:
                self.seq = None
            self._instance = instance

    def is_new(self, seq: int, t_ns: int) -> bool:
        """Return whether a pose is newer than all before, and take it for the newest if so.

        t_ns: instant of the pose, gateway time.
        """
        if self.seq is not None and seq <= self.seq and t_ns <= self._t_ns:
            return False
        self.seq, self._t_ns = seq, t_ns
        return True
