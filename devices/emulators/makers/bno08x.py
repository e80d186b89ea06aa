"""Lets the modules of an emulated suit speak as BNO08x in UART-RVC mode."""

from __future__ import annotations

from devices.deferred import Rotation
from devices.emulators.makers.vendor_emulator import Fused, Sensed, VendorEmulator
from devices.vendor_protocols.bno08x import Report, encode


class Bno08xEmulator(VendorEmulator):
    """Orientations as Euler angles; the acceleration is that at rest."""

    is_fused = True

    def encode_sample(self, sensed: Sensed) -> bytes:
        """Return nothing: it sends no raw values."""
        return b""

    def encode_fused(self, fused: Fused) -> bytes:
        """Return the report of one orientation."""
        turned = Rotation.from_quat(fused.orientation, scalar_first=True)
        yaw, pitch, roll = turned.as_euler("ZYX", degrees=True).tolist()
        x, y, z = turned.inv().apply([0.0, 0.0, 1.0]).tolist()
        return encode(Report(fused.sequence & 0xFF, (yaw, pitch, roll), (x, y, z)))
