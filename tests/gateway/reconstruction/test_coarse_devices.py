"""Position devices as coarse as radio beacons: they may tell little, but lead nothing astray."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.body.skeleton import WornSuit
from gateway.emulation.fast_arm import sampled
from gateway.emulation.random_chains import RandomChain, drawn
from gateway.frames import Quantity
from gateway.geometry.comparison import orientation_error
from gateway.reconstruction.inertial.tree.devices import derivative_weights, take_reading
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings, JointReconstructor
from gateway.reconstruction.inertial.tree.state import N_READINGS, initial_state
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.reconstructor import update_many

TUNING = tuning()


@pytest.mark.parametrize(("sigma_m", "every_s"), [(0.1, 0.1), (0.02, 0.03), (0.3, 0.2)])
@pytest.mark.parametrize("seed", [7048, 7003])
def test_a_coarse_device_is_no_worse_than_none(seed: int, sigma_m: float, every_s: float) -> None:
    """Fitted over a fifth of a second, 10 cm at 10 Hz said nothing, but took the place of what is known
    without a device: errors of 17°. What a coarse device says of the heading is followed for a while even
    where the field knows better."""
    chain = drawn(seed)
    assert chain.held_by == "position device"
    chain = chain._replace(
        switches=replace(chain.switches, device_sigma_m=sigma_m, device_every_s=every_s), rate_hz=100.0
    )
    with_device = _mean_error_deg(chain, chain.suit)
    without = _mean_error_deg(chain, replace(chain.suit, local_devices=()))
    assert with_device < max(1.2 * without, 1.3)


@pytest.mark.parametrize("seed", [22006, 22012])
def test_a_device_far_from_the_root_shows_the_heading_of_the_whole_body(seed: int) -> None:
    """Linear rows of a heading that was a quarter turn off left 14 to 21° after six seconds."""
    chain = drawn(seed)
    assert chain.held_by == "position device"
    assert chain.suit.skeleton.parents[chain.suit.local_devices[0].segment] >= 0
    observed = sampled(chain.suit, chain.motion, chain.switches, seed, chain.rate_hz, 8.0)
    body = JointReconstructor(chain.suit, 1.0 / chain.rate_hz, ChainSettings(uses_field=False))
    poses = [pose for pose in update_many(body, observed) if pose.time_ns > 6e9]
    truth = chain.motion.state(np.array([pose.time_ns for pose in poses]) * 1e-9).q_wb
    error = orientation_error(np.stack([pose.q_wb for pose in poses]), truth)
    assert np.degrees(error.total.max()) < 9.0


def _mean_error_deg(chain: RandomChain, suit: WornSuit) -> float:
    observed = sampled(chain.suit, chain.motion, chain.switches, chain.seed, chain.rate_hz)
    poses = update_many(JointReconstructor(suit, 1.0 / chain.rate_hz), observed)
    settled = [pose for pose in poses if pose.time_ns > 4e9]
    truth = chain.motion.state(np.array([pose.time_ns for pose in settled]) * 1e-9).q_wb
    error = orientation_error(np.stack([pose.q_wb for pose in settled]), truth)
    return float(np.degrees(np.sqrt(np.mean(error.total**2))))


@pytest.mark.parametrize(
    ("kind", "sigma"), [(Quantity.POSITION, 0.01), (Quantity.POSITION, 0.05), (Quantity.VELOCITY, 0.2)]
)
def test_the_window_leaves_what_is_asked_of_the_readings_noise(kind: Quantity, sigma: float) -> None:
    window_s = _window_s(kind, [sigma])
    times = np.linspace(0.0, window_s, N_READINGS)
    order = 2 if kind is Quantity.POSITION else 1
    left = sigma * float(np.sqrt(np.sum(derivative_weights(times, order) ** 2)))
    assert left == pytest.approx(
        TUNING.local_acceleration, rel=0.2
    )  # √720 and √12 are those of many readings


def test_windows_have_a_least_and_a_longest_and_do_not_flutter() -> None:
    assert _window_s(Quantity.POSITION, [0.0]) == TUNING.local_window_s
    assert _window_s(Quantity.ACCELERATION, [5.0]) == TUNING.local_window_s
    assert _window_s(Quantity.AIR_VELOCITY, [5.0]) == TUNING.local_window_s
    assert _window_s(Quantity.POSITION, [50.0]) == TUNING.local_longest_window_s
    little_more = 0.05 * 0.9 * TUNING.local_window_change**2
    assert _window_s(Quantity.POSITION, [0.05, little_more]) == _window_s(Quantity.POSITION, [0.05])
    assert _window_s(Quantity.POSITION, [0.05, 0.2]) == _window_s(Quantity.POSITION, [0.2])


def _window_s(kind: Quantity, sigmas: list[float]) -> float:
    """Of a device that has given readings that certain."""
    device = initial_state(1, 1).devices[0]
    for k, sigma in enumerate(sigmas):
        take_reading(device, int(kind), float(k), np.zeros(3), sigma, TUNING)
    return float(device.fit_span_s)
