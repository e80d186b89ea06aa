"""Chains drawn at random, with known truth, no two alike.

Two to nine segments in a row or in branches, held by a fixed point or a position device somewhere on them,
or by nothing; slow or fast, firm or on soft tissue, near iron or not, from rest or in mid-motion, at 50 to
200 Hz.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from devices.emulators.motion.motions import BodyMotion, generic_motion
from gateway.body.skeleton import LocalDevice, Skeleton, WornSuit, field_vector
from gateway.emulation.fast_arm import POSITION_DEVICE, Switches
from gateway.emulation.rig import dress
from gateway.emulation.simulation import ALREADY_MOVING
from gateway.frames import Quantity

HELD_BY = ("fixed point", "position device", "nothing")


class RandomChain(NamedTuple):
    """A chain, how it moves and what is wrong with its sensors."""

    seed: int
    held_by: str
    suit: WornSuit
    motion: BodyMotion
    peak_rate: float
    """rad/s, of any segment."""
    begins_at_rest: bool
    rate_hz: float
    switches: Switches

    def described(self) -> list[str]:
        """Return cells of a table; see ``HEADS``."""
        wrong = [
            f"arms {100 * self.switches.lever_arm_m:.0f} cm",
            *([f"device {self._device()}"] if self.held_by == "position device" else []),
            *(["soft tissue"] if self.switches.has_wobble else []),
            *(["iron"] if self.switches.is_field_disturbed else []),
            *([] if self.begins_at_rest else ["mid-motion"]),
        ]
        parents = " ".join(str(parent) for parent in self.suit.skeleton.parents[1:])
        return [
            str(self.seed),
            self.held_by,
            parents,
            f"{self.peak_rate:.0f}",
            f"{self.rate_hz:.0f}",
            ", ".join(wrong),
        ]

    def _device(self) -> str:
        noise, every_s = f"{1000 * self.switches.device_sigma_m:.0f} mm", self.switches.device_every_s
        return f"{noise} at {1 / every_s:.0f} Hz" if every_s else noise


HEADS = ["seed", "held by", "parents", "rad/s", "Hz", "wrong"]


def drawn(seed: int) -> RandomChain:
    """Return the chain of a seed; three in a row are held by one thing each."""
    rng = np.random.default_rng([seed, 21])
    held_by = HELD_BY[seed % len(HELD_BY)]
    suit = _suit(rng, held_by)
    # Evenly over the orders of magnitude, not over the values.
    peak_rate = float(np.exp(rng.uniform(np.log(2.0), np.log(20.0))))
    begins_at_rest = bool(rng.random() < 0.7)
    motion = generic_motion(
        dress(suit),
        seed,
        peak_angular_rate=peak_rate,
        peak_angular_acceleration=peak_rate * float(rng.uniform(5.0, 11.0)),
        root_travel_m=0.0 if held_by == "fixed point" else float(rng.uniform(0.05, 0.4)),
        fade=None if begins_at_rest else ALREADY_MOVING,
    )
    switches = Switches(
        lever_arm_m=float(rng.uniform(0.0, 0.03)),
        device_m=float(rng.uniform(0.0, 0.03)),
        has_wobble=bool(rng.random() < 0.3),
        clock_residue_s=float(rng.uniform(0.0, 2e-4)),
        is_field_disturbed=bool(rng.random() < 0.3),
    )
    rate_hz = float(rng.choice([50.0, 100.0, 200.0]))
    switches = replace(
        switches,
        device_sigma_m=float(np.exp(rng.uniform(np.log(0.001), np.log(0.1)))),
        device_every_s=float(rng.choice([0.2, 0.1, 0.03, 0.0])),
    )
    return RandomChain(seed, held_by, suit, motion, peak_rate, begins_at_rest, rate_hz, switches)


def _suit(rng: np.random.Generator, held_by: str) -> WornSuit:
    n = int(rng.integers(2, 10))
    # Mostly one link after the other, at times a branch.
    parents = np.array([-1, *(i - 1 if rng.random() < 0.7 else int(rng.integers(0, i)) for i in range(1, n))])
    lengths = rng.uniform(0.1, 0.5, n)
    offsets, tips, lever_arms = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    tips[:, 2] = lengths
    offsets[1:, 2] = lengths[parents[1:]] * rng.choice([1.0, 0.6], n - 1, p=[0.8, 0.2])
    lever_arms[:, :2] = rng.uniform(-0.05, 0.05, (n, 2))
    lever_arms[:, 2] = lengths * rng.uniform(0.2, 0.8, n)
    return WornSuit(
        skeleton=Skeleton("random_chain", tuple(f"link_{i + 1}" for i in range(n)), parents, offsets, tips),
        module_ids=tuple(range(n)),
        module_of_segment=np.arange(n),
        sensor_to_segment=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        lever_arms=lever_arms,
        local_devices=_devices(rng, held_by, lengths),
        gravity=np.array([0.0, 0.0, -9.81]),
        magnetic_field=field_vector(50.0, float(rng.uniform(0.0, 75.0))),
    )


def _devices(rng: np.random.Generator, held_by: str, lengths: np.ndarray) -> tuple[LocalDevice, ...]:
    if held_by == "fixed point":
        return (LocalDevice(Quantity.FIXED_POINT, 0, np.zeros(3)),)
    if held_by == "position device":
        segment = int(rng.integers(0, len(lengths)))
        place = np.array([0.0, 0.0, rng.uniform(0.0, lengths[segment])])
        return (LocalDevice(Quantity.POSITION, segment, place, POSITION_DEVICE),)
    return ()
