"""A BNO085 as its manuals describe it: messages in transfers, features asked for, reports as time passes.

Written from the reference manuals of SHTP and SH-2, and not from the driver.
"""

from __future__ import annotations

import struct
from collections import deque
from math import radians

from tests.firmware.register_models import Felt

G = 9.80665
COMMANDS, EXECUTABLE, CONTROL, REPORTS = range(4)
FASTEST_HZ = {0x01: 500.0, 0x07: 400.0, 0x0F: 100.0}
RANGE = {0x01: 8 * G, 0x07: radians(2000), 0x0F: 1300.0}
Q_POINT = {0x01: 8, 0x07: 9, 0x0F: 4}
RESET_US, ANSWER_US = 200_000, 4_000


class Bno085:
    """The hub behind its bus; ``read`` and ``write`` are transfers."""

    def __init__(self) -> None:
        self.felt = Felt()
        self.now_us = 0
        self.intervals_us: dict[int, int] = {}
        self.calibrates = {"accelerometer": True, "gyroscope": True, "magnetometer": True}
        self.is_there = True
        self._waiting: deque[tuple[int, int, bytes]] = deque()  # from when, channel, content
        self._due_us: dict[int, int] = {}
        self._sequences = [0] * 6
        self._rest = b""
        self._rest_channel = 0

    def say(self, channel: int, content: bytes, in_us: int = 0) -> None:
        """Have a message wait for the host."""
        self._waiting.append((self.now_us + in_us, channel, content))

    def pass_time(self, us: int) -> None:
        """Measure what is due meanwhile."""
        end_us = self.now_us + us
        while self._due_us and min(self._due_us.values()) <= end_us:
            feature = min(self._due_us, key=self._due_us.__getitem__)
            self.now_us = self._due_us[feature]
            self._due_us[feature] += self.intervals_us[feature]
            self.say(REPORTS, struct.pack("<BI", 0xFB, 12) + self._report(feature))
        self.now_us = end_us

    def read(self, capacity: int) -> bytes:
        """One transfer to the host: what waits, or the rest of what did not fit; nothing: empty."""
        if not self.is_there:
            return b""
        if self._rest:
            head, content = 0x8000, self._rest
        elif self._waiting and self._waiting[0][0] <= self.now_us:
            head = 0
            _, self._rest_channel, content = self._waiting.popleft()
        else:
            return b""
        length = len(content) + 4
        taken, self._rest = content[: capacity - 4], content[capacity - 4 :]
        number = self._sequences[self._rest_channel]
        self._sequences[self._rest_channel] = (number + 1) % 256
        return struct.pack("<HBB", head | length, self._rest_channel, number) + taken

    def write(self, data: bytes) -> None:
        """One transfer from the host."""
        length, channel, _ = struct.unpack_from("<HBB", data)
        assert length == len(data)
        content = data[4:]
        if channel == EXECUTABLE and content == b"\1":
            self._reset()
        elif channel == CONTROL:
            self._obey(content)

    def _reset(self) -> None:
        self._waiting.clear()
        self._due_us, self.intervals_us, self._rest = {}, {}, b""
        self.calibrates = dict.fromkeys(self.calibrates, True)
        self.say(COMMANDS, bytes(280), RESET_US)  # the advertisement
        self.say(EXECUTABLE, b"\1", RESET_US)
        self.say(CONTROL, bytes([0xF1, *[0] * 15]), RESET_US)

    def _obey(self, content: bytes) -> None:
        if content[0] == 0xF9:
            self.say(CONTROL, bytes([0xF8, *[0] * 15]), ANSWER_US)
        elif content[0] == 0xF2 and content[2] == 7 and content[6] == 0:
            wanted = zip(self.calibrates, content[3:6], strict=True)
            self.calibrates = {name: bool(value) for name, value in wanted}
        elif content[0] == 0xFD:
            assert len(content) == 17
            feature, (interval_us,) = content[1], struct.unpack_from("<I", content, 5)
            self.intervals_us[feature] = max(interval_us, round(1e6 / FASTEST_HZ[feature]))
            self._due_us[feature] = self.now_us + self.intervals_us[feature]

    def _report(self, feature: int) -> bytes:
        felt = {
            0x01: [G * a for a in self.felt.acceleration_g],
            0x07: [radians(w) for w in self.felt.rate_dps],
            0x0F: list(self.felt.field_ut),
        }[feature]
        most = RANGE[feature]
        raw = [round(max(-most, min(most, value)) * 2 ** Q_POINT[feature]) for value in felt]
        offsets = [0, 0, 0] * (feature != 0x01)
        return struct.pack(f"<4B{len(raw + offsets)}h", feature, 0, 3, 0, *raw, *offsets)
