"""The steps of the tree filter beside plain NumPy: dense covariance, whole matrices, one formula a line.

Chains drawn at random move, with local devices, gaps and clipped sensors. At every frame what is compiled
starts from the same state as the reference, so that nothing but rounding is between the two.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.emulation.fast_arm import sampled
from gateway.emulation.random_chains import drawn
from gateway.frames import Clipped, Status
from gateway.reconstruction.inertial import chain_frames, chain_rows, chain_step
from gateway.reconstruction.inertial.chain_state import Started, Validity
from gateway.reconstruction.inertial.joint import JointReconstructor, OutwardReconstructor

N_FRAMES = 250


def skew(v):
    return np.cross(v, np.eye(3)).T


def dense_tree(parents, P, C):
    """(6n, 6n) covariance that is Markov on the tree and has these blocks."""
    dense = np.zeros((6 * len(parents), 6 * len(parents)))
    for s, p in enumerate(parents):
        own = slice(6 * s, 6 * s + 6)
        dense[own, own] = P[s]
        if p >= 0:
            parent = slice(6 * p, 6 * p + 6)
            dense[own, : 6 * s] = C[s] @ np.linalg.solve(P[p], dense[parent, : 6 * s])
            dense[: 6 * s, own] = dense[own, : 6 * s].T
    return dense


def blocks(dense, s, p):
    return dense[6 * s : 6 * s + 6, 6 * p : 6 * p + 6]


def assert_close(actual, expected):
    """By the largest element: a block holds rad² and (rad/s)²."""
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max() + 1e-15)


class Checked:
    """The compiled steps, each held against its reference."""

    def __init__(self):
        self.compared = dict.fromkeys(("predict", "coast", "average", "joint_row", "update"), 0)

    def predict(self, body, state, tuning, work, dt):
        before, segments = state.segments.copy(), state.segments
        predict(body, state, tuning, work, dt)
        parents = body.segments["parent"]
        started = [s for s in range(len(parents)) if before[s].started != Started.NO]
        dense = dense_tree(parents, before["P"] + 1e-12 * np.eye(6), before["C"])
        F, Q = np.eye(len(dense)), np.zeros(len(dense))
        for s in started:
            F[6 * s : 6 * s + 3, 6 * s + 3 : 6 * s + 6] = -before["R"][s] * dt
            turn, density = self.turned(before[s], work.segments[s], tuning, dt)
            R = before["R"][s] @ Rotation.from_rotvec(turn * dt).as_matrix()
            np.testing.assert_allclose(segments[s].R, R, atol=1e-13)
            is_lost = np.diag(F @ dense @ F.T)[6 * s : 6 * s + 3] >= tuning.unknown_heading**2
            Q[6 * s : 6 * s + 3] = np.where(is_lost, 0.0, density * dt)
            Q[6 * s + 3 : 6 * s + 6] = tuning.bias_walk**2 * dt
        after = F @ dense @ F.T + np.diag(Q)
        for s in started:
            assert_close(segments[s].P, blocks(after, s, s))
            if body.world.is_tree and parents[s] >= 0 and parents[s] in started:
                assert_close(segments[s].C, blocks(after, s, parents[s]))

    def turned(self, before, now, tuning, dt):
        """Mean rate over the step, rad/s, and the density of its noise, (rad/s)²/Hz."""
        a = before.rate - before.bias
        if now.validity == Validity.NOTHING:
            self.compared["coast"] += 1
            w = a * np.exp(-dt / tuning.longest_coast_s)
            return w, (tuning.dead_rate**2 + w @ w) * tuning.longest_coast_s
        self.compared["predict"] += 1
        b, change = now.angular_rate - before.bias, now.angular_rate - before.rate
        w = (a + b) / 2.0 + np.cross(a, b) * dt / 12.0
        w = w - np.nan_to_num(change - before.rate_slope * dt) / 12.0
        density = tuning.gyroscope**2 + (tuning.gyroscope_scale**2 * (w @ w)) * tuning.scale_memory_s
        if now.validity == Validity.SATURATED_RATE:
            density += tuning.saturated_noise**2
        return w, density + before.corrections.gyroscope * (change @ change) * dt

    def average(self, state, tuning, work, dt):
        before = state.segments.copy()
        average(state, tuning, work, dt)
        gain = 1.0 - np.exp(-dt / tuning.smoothing_s)
        for s, now in enumerate(work.segments):
            one = before[s]
            if now.validity == Validity.FORCE and one.averages.seconds > 0.0:
                self.compared["average"] += 1
                filled = 1.0 - np.exp(-(one.averages.seconds + dt) / tuning.smoothing_s)
                W = one.R @ skew(now.angular_rate - one.bias)
                K = gain / dt / filled * (W - one.averages.lever_arm_matrix)
                assert_close(now.K, K)
                f = 0.5 * (one.R @ (now.specific_force - one.force_bias) + one.averages.last_force)
                mean = one.averages.force + gain / filled * (f - one.averages.force)
                assert_close(state.segments[s].averages.force, mean)

    def joint_row(self, joint, is_unobserved, tuning, dt):
        child, parent, now = joint.child.copy(), joint.parent.copy(), joint.now.copy()
        joint_row(joint, is_unobserved, tuning, dt)
        nis = joint.child.joint_nis
        if is_unobserved or nis >= tuning.loose_nis:
            return
        self.compared["joint_row"] += 1
        residual, H = now.u - now.u_parent, skew(0.5 * (now.u + now.u_parent))
        D = (child.P + parent.P - child.C - child.C.T)[:3, :3]
        at_once = now.row_variance * min(1.0, dt / tuning.row_memory_s)
        off = np.diag(H @ D @ H.T)
        found = min(residual @ residual / (off + at_once).sum(), tuning.largest_nis)
        gain = 1.0 - np.exp(-dt / tuning.joint_nis_memory_s)
        assert nis == pytest.approx(child.joint_nis + gain * (found - child.joint_nis))
        inflation = max(1.0, nis)
        deviations = np.sqrt(np.sum(residual**2 / (off + inflation * at_once)))
        variance = now.row_variance * inflation * max(1.0, deviations / tuning.huber)
        told, before = joint.now.evidence, now.evidence
        assert_close(told.cc - before.cc, H.T @ H / variance)
        assert_close(told.cp - before.cp, -H.T @ H / variance)
        assert_close(told.c - before.c, H.T @ residual / variance)

    def update_tree(self, links, segments, work):
        n, parents, told = len(links), links["parent"], work.segments["evidence"].copy()
        dense = dense_tree(parents, segments["P"], segments["C"])
        information, vector = np.zeros_like(dense), np.zeros(len(dense))
        for s, p in enumerate(parents):
            own, c = slice(6 * s, 6 * s + 6), slice(6 * s, 6 * s + 3)
            information[own, own] += told["own"][s]
            vector[own] += told["own_vector"][s]
            if p >= 0:
                above = slice(6 * p, 6 * p + 3)
                information[c, c] += told["cc"][s]
                information[c, above] += told["cp"][s]
                information[above, c] += told["cp"][s].T
                information[above, above] += told["pp"][s]
                vector[c] += told["c"][s]
                vector[above] += told["p"][s]
        update_tree(links, segments, work)
        after = np.linalg.solve(np.eye(6 * n) + dense @ information, dense)
        x = (after @ vector).reshape(n, 6)
        for s, p in enumerate(parents):
            if np.trace(dense[6 * s : 6 * s + 6, 6 * s : 6 * s + 6]) > 0.0:
                self.compared["update"] += 1
                assert_close(work.segments[s].x, x[s])
                assert_close(segments[s].P, blocks(after, s, s))
                if p >= 0:
                    assert_close(segments[s].C, blocks(after, s, p))


predict, average, joint_row, update_tree = (
    chain_step.predict,
    chain_step.average,
    chain_rows.joint_row,
    chain_step.update_tree,
)


def disturbed(chain):
    """Frames with modules that fall silent for up to 1.2 s and sensors that are at the end of their range."""
    rng, out = np.random.default_rng(chain.seed), []
    frames = sampled(chain.suit, chain.motion, chain.switches, chain.seed, chain.rate_hz)[:N_FRAMES]
    silent, clipped = np.zeros((2, len(frames[0].status)), int)
    for k, frame in enumerate(frames):
        if k > N_FRAMES // 3:
            silent = np.where(rng.random(silent.shape) < 0.005, rng.choice([1, 10, 120]), silent - 1)
            clipped = np.where(rng.random(clipped.shape) < 0.005, rng.choice([1, 10]), clipped - 1)
        force = np.where(silent[:, None] > 0, np.nan, frame.specific_force)
        status = np.where(silent > 0, Status.MISSING, frame.status).astype(np.uint8)
        at_end = np.where(clipped > 0, Clipped.ANGULAR_RATE, 0).astype(np.uint8)
        out.append(replace(frame, specific_force=force, status=status, clipped=at_end))
    return out


@pytest.mark.parametrize("kind", [JointReconstructor, OutwardReconstructor])
@pytest.mark.parametrize("seed", [7000, 7005, 7007, 7012])
def test_every_step_is_that_of_the_dense_filter(kind, seed, monkeypatch):
    chain, checked = drawn(seed), Checked()
    body = kind(chain.suit, 1.0 / chain.rate_hz)
    for name in ("predict", "average", "update_tree"):
        monkeypatch.setattr(chain_step, name, getattr(checked, name))
    monkeypatch.setattr(chain_rows, "joint_row", checked.joint_row)
    for module, name in (
        (chain_step, "_joint_row"),
        (chain_step, "_joint_rows"),
        (chain_step, "step"),
        (chain_frames, "_advance"),
        (chain_frames, "advance"),
    ):
        monkeypatch.setattr(module, name, getattr(module, name).__wrapped__)
    monkeypatch.setattr(chain_frames, "step", chain_step.step)
    monkeypatch.setattr("gateway.reconstruction.inertial.joint.advance", chain_frames.advance)
    body.update_many(disturbed(chain))
    compared = checked.compared
    assert compared["predict"] > N_FRAMES
    assert compared["average"] > N_FRAMES
    assert compared["coast"] > 0
    assert compared["joint_row"] > 0
    assert (compared["update"] > N_FRAMES) == (kind is JointReconstructor)
