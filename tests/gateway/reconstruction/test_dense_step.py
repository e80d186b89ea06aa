"""The steps of the tree filter beside plain NumPy: dense covariance, whole matrices, one formula a line.

Chains drawn at random move, with local devices, a sun, gaps and clipped sensors. At every frame what is
compiled starts from the same state as the reference, so that nothing but rounding is between the two. Numbers
are those of ``docs/explanation/estimator.md``.
"""

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.emulation.fast_arm import sampled
from gateway.emulation.random_chains import drawn
from gateway.frames import Clipped, Status, SunSight
from gateway.reconstruction.inertial.tree import devices, rows
from gateway.reconstruction.inertial.tree import step as tree_step
from gateway.reconstruction.inertial.tree.reconstructor import JointReconstructor, OutwardReconstructor
from gateway.reconstruction.inertial.tree.state import Clip, Heading, Started, Validity

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


def outliers(residual, S, variance, huber):
    """(17)."""
    return max(1.0, np.sqrt(np.sum(residual**2 / (S + variance))) / huber)


def known(P, u, y, variance, huber):
    """(14), (14a): information matrix and vector about an orientation, of a vector u known to be y."""
    H, r = skew(y), u - y
    S = np.diag(H @ P[:3, :3] @ H.T)
    v = variance * outliers(r, S, variance, huber)
    angle = np.arctan2(np.linalg.norm(np.cross(u, y)), u @ y)
    whole = min(2.0 * np.tan(0.5 * angle) / np.sin(angle), 20.0) if angle > 1e-6 else 1.0
    longer = 1.0 + S.sum() / (S.sum() + 3.0 * variance) * (whole - 1.0)
    return H.T @ H / (v * longer**2), H.T @ r / (v * longer)


def open_known(u, y, variance):
    """(14) while the heading is not known: only how long the horizontal parts are."""
    H = skew(u)
    H[:2, :2] = 0.5 * (H + skew(y))[:2, :2]
    H[2, :2] = skew(0.5 * (u + y))[2, :2]
    H[:, 2] = 0.0
    wide = variance + u[:2] @ u[:2] + y[:2] @ y[:2]
    V = np.diag([1.0 / wide, 1.0 / wide, 1.0 / variance])
    return H.T @ V @ H, H.T @ V @ (u - y)


def learnt(P, A, residual, off, memory, learning, huber):
    """(42), (43), row by row: the constants' change, their covariance after it, and (46)."""
    P, e, added = P.copy(), np.zeros(6), np.trace(A @ P @ A.T) / 3.0
    for i in range(3):
        a = A[i]
        uncertain, innovation = a @ P @ a, residual[i] - a @ e
        v = learning.variance + off[i] * memory
        v *= max(1.0, abs(innovation) / huber / np.sqrt(learning.at_once + off[i] + uncertain))
        k = P @ a / (uncertain + v)
        e, P = e + k * innovation, P - np.outer(k, a @ P)
    return e, P, added


def missed(slope, seconds, tuning):
    """(69): variance of what a gyroscope at its end has missed."""
    noise = tuning.saturated_noise**2 * seconds
    square = slope @ slope * seconds**4 / 9.0
    return min(square, noise) if np.isfinite(square) else noise


def shaken(seen, x, floor, shock):
    """(12a) of a reading, and the mean square of (12)."""
    fourth = x - 4.0 * seen.last[:, 0] + 6.0 * seen.last[:, 1] - 4.0 * seen.last[:, 2] + seen.last[:, 3]
    square, step = fourth @ fourth, x - seen.last[:, 0]
    is_shock = square / 210.0 > shock * max(seen.square, floor**2)
    return 0.5 * np.sqrt(min(square, step @ step)) if is_shock else 0.0, square / 210.0


def shocks(segment, arm, tuning, dt):
    """η of (12b)."""
    turning = (2.0 * segment.rate_vibration.shock + segment.averages.rate_shock) / tuning.smoothing_s
    square = segment.averages.force_shock**2 + turning**2 * (arm @ arm)
    return square / 3.0 * max(1.0, tuning.smoothing_s / dt)


def own(work):
    """Copies of what segments have been told of themselves."""
    told = work.segments["evidence"]
    return told["own"].copy(), told["own_vector"].copy()


def start_square(body, now, tuning):
    """a_0² of (64)."""
    f, w = now.specific_force, now.angular_rate
    felt = np.linalg.norm(f) - np.linalg.norm(body.world.gravity)
    return felt**2 + (tuning.start_arm * (w @ w)) ** 2


def shows_speed(segment, tuning):
    return segment.P[0, 0] + segment.P[1, 1] <= tuning.aided_tilt**2


class Checked:
    """The compiled steps, each held against its reference."""

    def __init__(self):
        self.compared = Counter()

    def told(self, what, work, before, s, row):
        """Compare what a segment was told of its orientation since ``before`` with a row."""
        self.compared[what] += 1
        after, (information, vector) = own(work), row
        scale = np.abs(after[0][s]).max() * 1e-12
        np.testing.assert_allclose(
            (after[0] - before[0])[s, :3, :3], information, rtol=1e-6, atol=scale + 1e-12
        )
        scale = np.abs(after[1][s]).max() * 1e-12 + 1e-9 * np.abs(vector).max()
        np.testing.assert_allclose((after[1] - before[1])[s, :3], vector, rtol=1e-6, atol=scale + 1e-12)

    def predict(self, body, state, tuning, work, dt):
        before, segments = state.segments.copy(), state.segments
        kernels.predict(body, state, tuning, work, dt)
        parents = body.segments["parent"]
        started = [s for s in range(len(parents)) if before[s].started != Started.NO]
        dense = dense_tree(parents, before["P"] + 1e-12 * np.eye(6), before["C"])
        F, Q = np.eye(len(dense)), np.zeros(len(dense))
        for s in started:
            F[6 * s : 6 * s + 3, 6 * s + 3 : 6 * s + 6] = -before["R"][s] * dt
            turn, density = self.turned(before[s], work.segments[s], segments[s].gap, tuning, dt)
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

    def turned(self, before, now, gap_after, tuning, dt):
        """Mean rate over the step, rad/s, and the density of its noise, (rad/s)²/Hz."""
        gap, memory_s = before.gap.seconds, tuning.longest_coast_s
        last = before.gap.rate if gap > 0.0 else before.rate
        square = tuning.dead_rate**2 + np.sum((last - before.bias) ** 2)

        def coasted(t):
            faded = np.exp(-t / memory_s)
            return square * memory_s**2 * (t / memory_s - 1.5 + 2.0 * faded - 0.5 * faded**2)

        if now.validity == Validity.NOTHING:
            self.compared["coast"] += 1
            w = (before.rate - before.bias) * np.exp(-dt / memory_s)
            self.hold_axes(before.gap, gap_after, w, dt)
            grown = coasted(gap + dt) - coasted(gap)
            if before.gap.cause == Clip.NONE:
                grown += before.gap.missed if gap > 0.0 else 0.0
                if gap + dt <= tuning.longest_bridge_s:  # apart, until it is bridged
                    assert gap_after.missed == pytest.approx(grown)
                    grown = 0.0
            return w, grown / dt
        is_made_up = before.gap.cause == Clip.LEFT
        is_bridged = gap > 0.0 and now.validity >= Validity.RATE and not is_made_up
        lasted = dt + gap if is_bridged else dt
        last = last if is_bridged else before.rate
        slope = before.rate_slope if not is_bridged or gap <= tuning.longest_bridge_s else np.full(3, np.nan)
        a, b, change = last - before.bias, now.angular_rate - before.bias, now.angular_rate - last
        w = (a + b) / 2.0 + np.cross(a, b) * lasted / 12.0
        w = w - np.nan_to_num(change - slope * lasted) / 12.0
        density = tuning.gyroscope**2 + (tuning.gyroscope_scale**2 * (w @ w)) * tuning.scale_memory_s
        if now.validity == Validity.SATURATED_RATE:
            self.compared["clipped"] += 1
            self.hold_axes(before.gap, gap_after, w, dt)
            w, _, _, lasted_s = self.made_up(before, now, w, tuning, dt)
            kept = before.gap.missed if gap > 0.0 else 0.0
            if gap > 0.0 and np.isnan(before.gap.last_slope[0]):  # of a silence, which is not bridged now
                density, kept = density + kept / dt, 0.0
            if lasted_s > tuning.longest_clip_s or lasted_s == 0.0:  # (69)
                start = before.gap.slope if gap > 0.0 else before.rate_slope
                grown = missed(start, gap + dt, tuning) - missed(start, gap, tuning)
                density += (grown + kept) / dt
            return w, density
        if is_made_up:
            density += before.corrections.gyroscope * (change @ change) * lasted
            w, square, is_lost, _ = self.made_up(before, now, w, tuning, dt)
            np.testing.assert_allclose(now.bridge, before.gap.turn + w * dt, atol=1e-13)
            off = before.gap.missed if is_lost or square == 0.0 else 0.0
            return w, density + (tuning.missed_share**2 * square + off) / dt
        self.compared["bridge" if is_bridged else "predict"] += 1
        density += before.corrections.gyroscope * (change @ change) * lasted
        if before.rate_vibration.samples >= 4.0 and not is_bridged:
            noise = tuning.gyroscope / np.sqrt(dt)
            shock, _ = shaken(before.rate_vibration, now.angular_rate, noise, tuning.rate_shock)
            density += shock**2 * dt * 2.0 / 3.0
            self.compared["rate_shock"] += shock > 0.0
        if not is_bridged:
            return w, density
        known_s = 2.0 * memory_s * np.tanh(lasted / (2.0 * memory_s))
        whole = w * (lasted if gap <= tuning.longest_bridge_s else known_s)  # (6) after a gap
        np.testing.assert_allclose(now.bridge, whole, atol=1e-13)
        off = square * memory_s * (lasted - known_s)  # known at both ends
        variance = density * lasted + self.bridged(before, slope, change, gap, dt, off, coasted(gap), tuning)
        return (whole - before.gap.turn) / dt, variance / dt

    def bridged(self, before, slope, change, gap, dt, off, coasted, tuning):
        """What the end of a gap adds, rad²: (6) after a long one, (6a) after a short one."""
        if gap > tuning.longest_bridge_s:
            return max(off - coasted, 0.0)
        lasted = gap + dt
        bend = np.sum(((change / lasted - slope) / (0.5 * lasted + 0.5 * dt)) ** 2)
        if np.isnan(bend):
            return off
        mean = bend if np.isnan(before.bend_square) else before.bend_square
        mean += min(1.0, lasted / tuning.vibration_memory_s) * (bend - mean)
        return min(off, max(bend, mean) * (lasted**3 / 12.0) ** 2)

    def hold_axes(self, before, after, w, dt):
        """(70): what axes at their ends have turned by, and the sums of where they were, as seen from now."""
        for k in np.flatnonzero(after.clip_left < 2.0):
            is_new = before.seconds == 0.0 or before.clip_left[k] > 1.0
            axis, turned, total = after.clipped_axes[k], before.clip_turn[k], before.clip_mean[k]
            turned, total = (0.0, np.zeros(3)) if is_new else (turned, total)
            step, half = Rotation.from_rotvec(-w * dt), Rotation.from_rotvec(-0.5 * w * dt)
            np.testing.assert_allclose(after.clip_turn[k], turned + axis @ w * dt, atol=1e-13)
            np.testing.assert_allclose(
                after.clip_mean[k], step.apply(total) + half.apply(axis) * dt, atol=1e-13
            )

    def made_up(self, before, now, w, tuning, dt):
        """(70): an axis that is back for its second sample gives the cubic's turn, less its own, outward.

        The mean rate with it, the sum of squares so far, whether an axis is lost, and the longest of those
        that stay at the end.
        """
        gap, is_fresh = before.gap, before.gap.seconds == 0.0
        square, is_lost = (0.0, False) if is_fresh else (gap.made_up, bool(gap.is_lost))
        since = np.zeros(3) if is_fresh else gap.clip_s
        since = np.where(now.clipped_axes.any(axis=1) | (since > 0.0), since + dt, 0.0)
        added, half = np.zeros(3), Rotation.from_rotvec(-0.5 * w * dt)
        for k in range(3):
            if is_fresh or gap.clip_left[k] != 1.0 or now.clipped_axes[k].any():
                continue
            axis, lasted_s, since[k] = gap.clipped_axes[k], gap.clip_s[k], 0.0
            if lasted_s > tuning.longest_clip_s or not np.isfinite(gap.clip_slope[k]):
                is_lost = True
                continue
            self.compared["made_up"] += 1
            last, slope = axis @ before.rate, axis @ (now.angular_rate - before.rate) / dt
            whole = lasted_s / 2.0 * (gap.clip_rate[k] + last) - axis @ before.bias * lasted_s
            whole += lasted_s**2 / 12.0 * (gap.clip_slope[k] - slope)
            along = whole - gap.clip_turn[k]
            along = along if along * gap.clip_turn[k] > 0.0 else 0.0
            added, square = added + half.apply(gap.clip_mean[k]) / lasted_s * along, square + along**2
        return w + added / dt, square, is_lost, since.max()

    def average(self, state, tuning, work, dt):
        before = state.segments.copy()
        kernels.average(state, tuning, work, dt)
        gain = 1.0 - np.exp(-dt / tuning.smoothing_s)
        for s, now in enumerate(work.segments):
            one = before[s]
            is_bridged = 0.0 < now.bridged_s <= tuning.longest_bridge_s
            if now.validity == Validity.FORCE and one.averages.seconds > 0.0 and is_bridged:
                self.bridged_average(one, now, state.segments[s].averages, tuning, dt)
            elif now.validity == Validity.FORCE and one.averages.seconds > 0.0:
                self.compared["average"] += 1
                filled = 1.0 - np.exp(-(one.averages.seconds + dt) / tuning.smoothing_s)
                W = one.R @ skew(now.angular_rate - one.bias)
                K = gain / dt / filled * (W - one.averages.lever_arm_matrix)
                assert_close(now.K, K)
                f = 0.5 * (one.R @ (now.specific_force - one.force_bias) + one.averages.last_force)
                mean = one.averages.force + gain / filled * (f - one.averages.force)
                after = state.segments[s]
                assert_close(after.averages.force, mean)
                for kept, last, new in (
                    ("force_shock", one.averages.force_shock, after.vibration.shock),
                    ("rate_shock", one.averages.rate_shock, after.rate_vibration.shock),
                ):
                    assert after.averages[kept] == pytest.approx(last + gain / filled * (new - last))
                self.vibration(one, now, state.segments[s].vibration, tuning, dt)

    def bridged_average(self, before, now, after, tuning, dt):
        """(8) and (9) in as many equal steps as the gap was long; (10) in one."""
        self.compared["bridged_average"] += 1
        n = round((now.bridged_s + dt) / dt)
        assert n * dt == pytest.approx(now.bridged_s + dt)
        gain, mean = 1.0 - np.exp(-dt / tuning.smoothing_s), before.averages.lever_arm_matrix.copy()
        R_last = before.R @ Rotation.from_rotvec(-now.bridge).as_matrix()
        last = R_last @ skew(before.gap.rate - before.bias)
        W = before.R @ skew(now.angular_rate - before.bias)
        filled = 1.0 - np.exp(-(before.averages.seconds + n * dt) / tuning.smoothing_s)
        for k in range(1, n + 1):
            on_the_way = last + (W - last) * k / n
            K = gain / dt / filled * (on_the_way - mean)
            mean += gain * (on_the_way - mean)
        assert_close(now.K, K)
        assert_close(after.lever_arm_matrix, mean)
        f = 0.5 * (before.R @ (now.specific_force - before.force_bias) + before.averages.last_force)
        share = (1.0 - np.exp(-n * dt / tuning.smoothing_s)) / filled
        assert_close(after.force, before.averages.force + share * (f - before.averages.force))

    def vibration(self, before, now, seen, tuning, dt):
        """(12)."""
        if before.vibration.samples < 4.0:
            return
        self.compared["vibration"] += 1
        f, was = now.specific_force - before.force_bias, before.vibration
        shock, square = shaken(was, f, tuning.vibration_floor, tuning.vibration_shock)
        limit = tuning.vibration_shock * max(was.square, tuning.vibration_floor**2)
        expected = was.square + min(1.0, dt / tuning.vibration_memory_s) * (min(square, limit) - was.square)
        assert seen.square == pytest.approx(expected, rel=1e-9)
        assert seen.shock == pytest.approx(shock, rel=1e-6)
        self.compared["force_shock"] += shock > 0.0

    def joint_row(self, joint, is_unobserved, tuning, dt):
        child, parent, now = joint.child.copy(), joint.parent.copy(), joint.now.copy()
        kernels.joint_row(joint, is_unobserved, tuning, dt)
        nis = joint.child.joint_nis
        if nis >= tuning.loose_nis:
            return
        if is_unobserved:
            tilts = [0.5 * np.trace(one.P[:2, :2]) for one in (child, parent)]
            bent = 0.375 * max(tilts) ** 2 * (now.u @ now.u) * max(1.0, tuning.tilt_memory_s / dt)
            self.open_joint_row(now, joint.now.evidence, max(1.0, nis), bent)
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

    def open_joint_row(self, now, told, inflation, bent):
        """(13) without the column of the headings, section 12."""
        self.compared["open_joint_row"] += 1
        u, u_p, before = now.u, now.u_parent, now.evidence
        variance = now.row_variance * inflation + bent
        wide = variance + u[:2] @ u[:2] + u_p[:2] @ u_p[:2]
        V = np.diag([1.0 / wide, 1.0 / wide, 1.0 / variance])
        H, H_p = skew(u), -skew(u_p)
        H[:, 2], H_p[:, 2] = 0.0, 0.0
        assert_close(told.cc - before.cc, H.T @ V @ H)
        assert_close(told.cp - before.cp, H.T @ V @ H_p)
        assert_close(told.pp - before.pp, H_p.T @ V @ H_p)
        assert_close(told.c - before.c, H.T @ V @ (u - u_p))
        assert_close(told.p - before.p, H_p.T @ V @ (u - u_p))

    def learn_joint_arms(self, joint, learning, tuning, dt):
        child, parent, now, above = (one.copy() for one in joint[1:])
        kernels.learn_joint_arms(joint, learning, tuning, dt)
        self.compared["joint_arms"] += 1
        A, H = np.hstack([-now.K, above.K]), skew(0.5 * (now.u + now.u_parent))
        D, lasts = (child.P + parent.P - child.C - child.C.T)[:3, :3], tuning.tilt_memory_s
        off = np.diag(H @ D @ H.T) + D[2, 2] * H[:, 2] ** 2 * lasts / tuning.row_memory_s  # (42)
        memory = tuning.row_memory_s / min(child.arms.since_s, tuning.row_memory_s)
        e, P, added = learnt(
            child.arms.covariance, A, now.u - now.u_parent, off, memory, learning, tuning.huber
        )  # fmt: skip
        arms = joint.child.arms
        assert_close(arms.error, child.arms.error + e)
        assert_close(arms.covariance, P)
        assert arms.row_variance == pytest.approx(added)
        assert_close(joint.now.u, now.u + now.K @ e[:3])
        assert_close(joint.now.u_parent, now.u_parent + above.K @ e[3:])

    def gather_heading(self, sums, u, y, variance, share, tuning, interval_s):
        """(54), as a complex number, and the sums of (55)."""
        before, pair = sums.copy(), complex(*y[:2]) * np.conj(complex(*u[:2])) / variance
        kernels.gather_heading(sums, u, y, variance, share, tuning, interval_s)
        self.compared["heading"] += 1
        keep = np.exp(-interval_s / tuning.heading_forgets_s)
        found = keep * complex(before.along, before.across) + pair
        assert complex(sums.along, sums.across) == pytest.approx(found, rel=1e-9, abs=1e-12)
        assert sums.length == pytest.approx(keep * before.length + abs(pair))
        square = (u[:2] @ u[:2] + y[:2] @ y[:2]) / variance
        assert sums.square == pytest.approx(keep * before.square + square)
        assert sums.expected == pytest.approx(keep * before.expected + 2.0 * share)

    def stance_rows(self, body, state, tuning, work, dt):
        before = own(work)
        kernels.stance_rows(body, state, tuning, work, dt)
        for s, now in enumerate(work.segments):
            segment, stands = state.segments[s], body.segments[s].stands
            is_still = stands or segment.zero_rate.still_s > tuning.zero_rate_s
            if now.stood_s > 0.0 and is_still and now.validity == Validity.FORCE:
                v = tuning.stance_acceleration**2 + (tuning.stance_arm * now.rolling) ** 2  # (38)
                v *= max(1.0, tuning.row_memory_s / dt)
                u = segment.R @ now.specific_force
                self.told(
                    "stance", work, before, s, known(segment.P, u, body.world.at_rest, v, tuning.huber)
                )  # fmt: skip
                assert now.aided

    def zero_rate_rows(self, state, tuning, work, dt):
        before, watched = own(work), state.segments.copy()
        kernels.zero_rate_rows(state, tuning, work, dt)
        gain = 1.0 - np.exp(-dt / tuning.zero_rate_window_s)
        for s, now in enumerate(work.segments):
            was, segment = watched[s].zero_rate, state.segments[s]
            is_now = segment.zero_rate
            if now.validity == Validity.NOTHING:
                continue
            self.compared["zero_rate_watch"] += 1
            off = now.angular_rate - was.rate
            assert_close(is_now.rate, was.rate + gain * off)
            assert is_now.rate_square == pytest.approx(was.rate_square + gain * (off @ off - was.rate_square))
            lasting = was.rate_lasting + gain * (off @ was.off_rate - was.rate_lasting)
            assert is_now.rate_lasting == pytest.approx(lasting, abs=1e-15)
            if is_now.still_s > tuning.zero_rate_s:
                self.compared["zero_rate"] += 1
                noise = max(is_now.rate_square - is_now.rate_lasting, 0.0) / 3.0
                v = tuning.zero_rate_sigma**2 * tuning.zero_rate_window_s / dt + noise  # (36)
                after = own(work)
                added = (after[0] - before[0])[s, 3:, 3:]
                np.testing.assert_allclose(added, np.eye(3) / v, rtol=1e-6, atol=1e-9 / v)
                beta = (is_now.rate - segment.bias) / v
                np.testing.assert_allclose((after[1] - before[1])[s, 3:], beta, rtol=1e-6, atol=1e-9 / v)

    def predict_velocities(self, body, state, tuning, work, dt):
        """(39), (39a): the velocity hangs on the tilt alone, of which the prediction keeps a part."""
        was = state.segments.copy()
        kernels.predict_velocities(body, state, tuning, work, dt)
        g = np.linalg.norm(body.world.gravity)
        for s, now in enumerate(work.segments):
            before, after, t = was[s].velocity, state.segments[s].velocity, was[s].P[:2, :2].trace() / 2.0
            waited_s = before.waits_s + dt
            if not now.is_felt or waited_s - dt > tuning.longest_bridge_s or t == 0.0:
                continue
            self.compared["velocity"] += 1
            old, noise = now.tilt_before, now.density * dt
            both = old + 0.5 * (t - old - noise)  # covariance of the tilt's error before with that after
            variance = before.variance + (g * before.tilted_s) ** 2 * old
            regression = g * before.tilted_s * np.clip(both / t, 0.0, 1.0) / g
            left = max(variance - (g * regression) ** 2 * t, before.variance)
            missed = was[s].felt_square * before.waits_s**2
            if now.validity == Validity.FORCE:
                missed += (state.segments[s].vibration.shock * dt) ** 2 * 2.0 / 3.0  # (12a)
            left += tuning.force_bias**2 * tuning.unaided_memory_s * waited_s + missed
            assert after.tilted_s == pytest.approx(regression + waited_s)
            assert after.variance == pytest.approx(left, rel=1e-6)
            f = was[s].R @ (now.specific_force - was[s].force_bias)
            assert_close(after.felt, before.felt + waited_s * (f - body.world.at_rest))

    def lasting_tilts(self, body, was, state, tuning, work, dt):
        """(40b): P of all segments of a chain, and C of its edges, grow by the same."""
        g, judges = np.linalg.norm(body.world.gravity), {}
        for s, now in enumerate(work.segments):
            is_judge = shows_speed(was[s], tuning) and was[s].velocity.tilted_s > 0.0
            if now.validity == Validity.FORCE and is_judge:
                judges.setdefault(now.chain, []).append(s)
        for s, now in enumerate(work.segments):
            grown = np.zeros(6)
            if now.chain in judges and not work.segments[now.chain].aided:
                j = min(judges[now.chain], key=lambda j: state.segments[j].velocity.square)
                square, lasting = state.segments[j].velocity.square, state.segments[j].velocity.lasting[:2]
                seen = 0.5 * lasting @ lasting - square - was[j].velocity.variance
                over = seen / (g * was[j].velocity.tilted_s) ** 2 - 0.5 * (was[j].P[0, 0] + was[j].P[1, 1])
                grown[:2] = max(over, 0.0) * (1.0 - np.exp(-dt / tuning.unaided_memory_s))
            assert_close(state.segments[s].P, was[s].P + np.diag(grown))
            p = body.segments[s].parent
            is_shared = body.world.is_tree and p >= 0 and work.segments[p].chain == now.chain
            assert_close(state.segments[s].C, was[s].C + is_shared * np.diag(grown))

    def unaided_rows(self, body, state, tuning, work, dt):
        before, was = own(work), state.segments.copy()
        kernels.unaided_rows(body, state, tuning, work, dt)
        self.lasting_tilts(body, was, state, tuning, work, dt)
        counts = Counter(now.chain for now in work.segments if now.validity == Validity.FORCE)
        for s, now in enumerate(work.segments):
            if now.validity != Validity.FORCE:
                continue
            segment, velocity, gain = (
                state.segments[s],
                was[s].velocity,
                1.0 - np.exp(-dt / tuning.speed_mean_s),
            )
            square = velocity.square
            lasting = velocity.felt
            if shows_speed(was[s], tuning):
                self.compared["seen"] += 1
                lasting = velocity.lasting + gain * (velocity.felt - velocity.lasting)
                square += gain * (np.mean((velocity.felt - lasting)[:2] ** 2) - square)  # (40a)
            assert_close(segment.velocity.lasting, lasting)
            assert segment.velocity.square == pytest.approx(square)
            if velocity.tilted_s == 0.0:
                if now.bridged_s > tuning.longest_bridge_s:
                    self.compared["after_gap"] += 1
                    u, v = segment.averages.last_force, segment.felt_square  # (71)
                    row = known(segment.P, u, body.world.at_rest, v, tuning.huber)
                    self.told("gravity", work, before, s, row)
                continue
            look = max(square, tuning.least_speed**2) * tuning.unaided_memory_s / dt
            # given the tilt, a scalar Kalman filter that sees a velocity of 0
            kept = 1.0 - velocity.variance / (velocity.variance + look)
            assert_close(segment.velocity.felt, kept * velocity.felt)
            assert segment.velocity.tilted_s == pytest.approx(kept * velocity.tilted_s)
            assert segment.velocity.variance == pytest.approx(kept * velocity.variance)
            u = body.world.at_rest + velocity.felt / velocity.tilted_s
            is_alone = work.segments[now.chain].aided and segment.P[:2, :2].trace() > tuning.unsettled_tilt**2
            v = (velocity.variance + look) / velocity.tilted_s**2  # (40)
            v *= 1 if is_alone else counts[now.chain]
            self.told("unaided", work, before, s, known(segment.P, u, body.world.at_rest, v, tuning.huber))

    def follow_sun(self, body, state, tuning, work, dt):
        before, was, e = own(work), state.segments.copy(), work.shared.sun.copy()
        kernels.follow_sun(body, state, tuning, work, dt)
        across = np.hypot(e[0], e[1])
        for s, now in enumerate(work.segments):
            P = was[s].P
            if now.validity < Validity.RATE or was[s].heading != Heading.OBSERVED:
                continue
            if P[2, 2] > tuning.sun_unsure**2 or not np.isfinite(now.sun.sum() + across):
                continue
            seen = was[s].R @ now.sun
            psi = np.angle(complex(*seen[:2]) * np.conj(complex(*e[:2])))
            height = np.arctan2(seen[2], np.hypot(*seen[:2])) - np.arctan2(e[2], across)
            v = (now.sun_sigma**2 + 0.5 * (P[0, 0] + P[1, 1]) * e[2] ** 2) / across**2  # (35)
            v *= 1.0 + (height / tuning.sun_height_tolerance) ** 2
            heading = min(P[2, 2], tuning.unknown_heading**2)
            v *= max(1.0, abs(psi) / np.sqrt(v + heading) / tuning.huber) * max(1.0, tuning.sun_memory_s / dt)
            information, vector = np.zeros((3, 3)), np.zeros(3)
            information[2, 2], vector[2] = 1.0 / v, -psi / v
            self.told("sun", work, before, s, (information, vector))

    def follow_field(self, body, state, tuning, work, dt):
        """(27) to (31) of every compass; what they make of it together is in ``test_compass``."""
        was = state.segments.copy()
        kernels.follow_field(body, state, tuning, work, dt)
        h = body.world.magnetic_field
        share = (h[:2] @ h[:2]) / (h @ h)
        for s, now in enumerate(work.segments):
            segment, before = state.segments[s], was[s].compass
            m = segment.R @ now.magnetic_field
            if segment.started != Started.YES or now.validity < Validity.RATE or not np.isfinite(m.sum()):
                continue
            self.compared["compass"] += 1
            compass = segment.compass
            largest = segment.R[2] @ segment.P[3:, 3:] @ segment.R[2]
            keep = np.exp(-np.linalg.norm(segment.rate) * dt)
            V = np.array([[before.variance, before.covariance], [before.covariance, before.rate_variance]])
            F = np.array([[1.0, dt], [0.0, keep]])
            x, V = F @ [before.angle, before.rate], F @ V @ F.T
            V[0, 0] += now.density * dt
            V[1, 1] += (1.0 - keep**2) * largest
            if V[1, 1] > largest:
                V[0, 1] = V[1, 0] = V[0, 1] * np.sqrt(largest / V[1, 1])
                V[1, 1] = largest
            V[0, 0] = min(V[0, 0], tuning.unknown_heading**2)
            seen = np.angle(complex(*m[:2]) * np.conj(complex(*h[:2])))  # (27)
            assert now.field_off == pytest.approx(seen, abs=1e-9)
            tilt = 0.5 * (segment.P[0, 0] + segment.P[1, 1])
            r = before.misread * tilt / (tilt + now.density * dt)
            b = tilt * (1.0 / share - 1.0)  # variance of what the tilt misreads
            steep = np.arctan2(m[2], np.hypot(*m[:2])) - np.arctan2(h[2], np.hypot(*h[:2]))
            strong = (np.linalg.norm(m) / np.linalg.norm(h) - 1.0) / tuning.norm_tolerance
            disturbed = 1.0 + (steep / tuning.dip_tolerance) ** 2 + strong**2
            assert now.disturbance == pytest.approx(disturbed)
            if before.seconds == 0.0:
                first = (before.scatter + b) * disturbed
                assert compass.variance == pytest.approx(min(first, tuning.unknown_heading**2))
                assert compass.angle == pytest.approx(seen, abs=1e-9)
                assert compass.misread == 1.0
                continue
            off = np.angle(np.exp(1j * (seen - x[0])))
            # errors of the compass, its rate, and what the tilt misreads: that is considered, not found
            P = np.zeros((3, 3))
            P[:2, :2], P[2, 2] = V, b
            P[0, 0] += r * r * b
            P[0, 2] = P[2, 0] = r * b
            H = np.array([-1.0, 0.0, 1.0])
            v = before.scatter * tuning.heading_memory_s / dt * disturbed  # (31)
            v *= max(1.0, abs(off) / np.sqrt(H @ P @ H + before.scatter) / tuning.huber)
            K = -P @ H / (H @ P @ H + v)
            K[0], K[2] = max(K[0], 0.0), 0.0
            assert_close(np.array([compass.angle, compass.rate]), x + K[:2] * off)
            A = np.eye(3) + np.outer(K, H)
            P = A @ P @ A.T + v * np.outer(K, K)
            assert compass.misread * b == pytest.approx(P[0, 2])
            assert compass.tilt_square == pytest.approx(compass.misread**2 * b)
            least = compass.scatter * tuning.heading_memory_s / (tuning.heading_memory_s + compass.seconds)
            of_angle = max(P[0, 0] - compass.tilt_square, least)  # (31a)
            assert compass.variance == pytest.approx(of_angle)
            assert compass.rate_variance == pytest.approx(P[1, 1])

    def turn_segments(self, body, state, work):
        """(30a); that all else turns is in (1)."""
        was = state.segments.copy()
        kernels.turn_segments(body, state, work)
        for s, now in enumerate(work.segments):
            turn, m = now.turn, was[s].R @ now.magnetic_field
            if not turn.any():
                continue
            E = Rotation.from_rotvec(turn).as_matrix()
            np.testing.assert_allclose(state.segments[s].R, E @ was[s].R, atol=1e-12)
            felt, rest = was[s].velocity, body.world.at_rest
            for name in ("felt", "lasting"):
                turned = E @ felt[name] + felt.tilted_s * (E @ rest - rest)  # (39b)
                assert_close(state.segments[s].velocity[name], turned)
            by_field = turn[2]
            if np.isfinite(m.sum()):
                by_field = np.angle(complex(*(E @ m)[:2]) * np.conj(complex(*m[:2])))
            by_tilt = np.angle(np.exp(1j * (by_field - turn[2])))
            self.compared["compass_turn"] += 1
            angle = was[s].compass.angle + turn[2] + was[s].compass.misread * by_tilt
            assert state.segments[s].compass.angle == pytest.approx(angle, abs=1e-9)

    def start_segments(self, body, state, tuning, work):
        was = state.segments["started"].copy()
        kernels.start_segments(body, state, tuning, work)
        g, h = body.world.gravity, body.world.magnetic_field
        for s, now in enumerate(work.segments):
            if was[s] == Started.YES or state.segments[s].started != Started.YES:
                continue
            self.compared["start"] += 1
            segment, f = state.segments[s], now.specific_force
            np.testing.assert_allclose(
                segment.R @ f / np.linalg.norm(f), -g / np.linalg.norm(g), atol=1e-9
            )  # (62)
            m = segment.R @ now.magnetic_field
            facing = complex(*m[:2]) * np.conj(complex(*h[:2]))
            assert facing.real > 0.0
            assert facing.imag == pytest.approx(0.0, abs=1e-9 * abs(facing))
            moved = start_square(body, now, tuning)
            tilt = min(tuning.start_tilt**2 + moved / (g @ g), tuning.unknown_heading**2)
            P = np.diag([tilt, tilt, tuning.unknown_heading**2] + [tuning.bias**2] * 3)  # (63)
            assert_close(segment.P, P)
            assert not segment.C.any()
            speed = max(tuning.unaided_speed**2, tuning.starting_share * moved * tuning.unaided_memory_s**2)
            assert segment.velocity.square == pytest.approx(speed)  # (65)

    def fixed_row(self, body, state, tuning, work, d, dt):
        mount, device = body.devices[d], state.devices[d].copy()
        s = mount.segment
        before, segment, now = own(work), state.segments[s].copy(), work.segments[s].copy()
        kernels.fixed_row(body, state, tuning, work, d, dt)
        u, y = segment.averages.force + now.K @ (mount.arm + device.shift), body.world.at_rest
        at_once = tuning.specific_force**2 + (tuning.lever_arm * now.motion) ** 2  # (19)
        learning = work.shared.learning
        v = at_once * tuning.row_memory_s / dt
        v += segment.vibration.square + shocks(segment, mount.arm, tuning, dt)  # (12b)
        assert learning.at_once == pytest.approx(v * dt / tuning.row_memory_s)
        R_bar = segment.R - tuning.smoothing_s * segment.averages.lever_arm_matrix
        u, added = self.point(tuning, work, d, state, (device, segment), np.hstack([-now.K, R_bar]), u, y, dt)
        force = state.segments[s].averages.force
        change = state.segments[s].force_bias - segment.force_bias
        np.testing.assert_allclose(force, segment.averages.force - R_bar @ change, atol=1e-9)  # (45)
        v += added * max(1.0, tuning.tilt_memory_s / dt)  # (20)
        self.told("fixed_point", work, before, s, known(segment.P, u, y, v, tuning.huber))

    def point(self, tuning, work, d, state, was, A, u, y, interval_s):
        """(44): the place of a device and the error of an accelerometer, learnt; u after that, and (46)."""
        device, segment = was
        H = skew(y)
        off = np.diag(H @ segment.P[:3, :3] @ H.T)
        memory = max(1.0, tuning.point_memory_s / interval_s)
        e, P, added = learnt(device.covariance, A, u - y, off, memory, work.shared.learning, tuning.huber)
        np.testing.assert_allclose(state.devices[d].shift, device.shift + e[:3], atol=1e-9)
        assert_close(state.devices[d].covariance, P)
        return u - A @ e, added

    def moving_row(self, body, state, tuning, work, d):
        mount, device, pair = body.devices[d], state.devices[d].copy(), work.shared.pair.copy()
        s = mount.segment
        before, segment, now = own(work), state.segments[s].copy(), work.segments[s].copy()
        above = [s]  # up to the root, as far as headings are observed and corrections reach it
        while body.segments[above[-1]].parent >= 0:
            above.append(body.segments[above[-1]].parent)
        is_known = state.segments["heading"] == Heading.OBSERVED
        reaches = len(above) == 1 or (body.world.is_tree and is_known[above[:-1]].all())
        is_open = not is_known[s] or now.turn[2] != 0.0 or (reaches and not is_known[above[-1]])
        kernels.moving_row(body, state, tuning, work, d)
        interval_s = min(device.age_s, pair.span_s)
        sharing = max(1.0, pair.span_s / interval_s)
        u, y = pair.u + pair.arm @ (mount.arm + device.shift), pair.y  # (25)
        v = pair.variance + tuning.specific_force**2 + (tuning.lever_arm * now.motion) ** 2
        v = (v + segment.vibration.square + pair.shock**2 / 3.0) * sharing  # (26)
        if is_open:
            # a root whose heading has just been shown is told that, too
            if len(above) > 1 or state.segments[s].heading == segment.heading:
                self.told("open_device", work, before, s, open_known(u, y, v))
            return
        A = np.hstack([-pair.arm, pair.turn])
        u, added = self.point(tuning, work, d, state, (device, segment), A, u, y, interval_s)
        v += sharing * added
        self.told("device", work, before, s, known(segment.P, u, y, v, tuning.huber))

    def find_local_pair(self, pair, device, mount, world, tuning, time_s):
        """(24), (25) of a device that measures positions, the fit by a pseudoinverse."""
        is_new = kernels.find_local_pair(pair, device, mount, world, tuning, time_s)
        if is_new:
            self.compared["pair"] += 1
            held = device.readings[: device.n_readings]
            ages = held[-1].time_s - np.array([reading.time_s for reading in held])
            count = max(4, int(np.sum(ages < 1.05 * device.fit_span_s)))
            t = np.array([reading.time_s for reading in held[-count:]])
            z = np.array([reading.value for reading in held[-count:]])
            x = t - t.mean()
            w = 2.0 * np.linalg.pinv(np.stack([x**0, x, x**2], axis=1))[2]
            np.testing.assert_allclose(pair.y, w @ z - world.gravity, rtol=1e-6, atol=1e-6)
            sigma = np.array([reading.sigma for reading in held[-count:]])
            assert pair.variance == pytest.approx(np.sum((w * sigma) ** 2), rel=1e-6)
            frames = [frame for frame in device.history if frame.time_s > -np.inf]
            k, u, shock = 0.0, np.zeros(3), 0.0
            for older, newer in pairwise(frames):
                if newer.time_s >= t[0]:
                    middle, step = 0.5 * (older.time_s + newer.time_s), newer.time_s - older.time_s
                    share = step * np.sum(w * np.maximum(t - middle, 0.0))
                    k, u = k + share, u + share * 0.5 * (older.force + newer.force)
                    shock += abs(share) * 0.5 * (older.shock + newer.shock)
            np.testing.assert_allclose(pair.u, device.turn @ u / k, rtol=1e-6, atol=1e-6)
            assert pair.shock == pytest.approx(shock)
        return is_new

    def update_outward(self, links, segments, work):
        parents, told = links["parent"], work.segments["evidence"].copy()
        P = segments["P"].copy()
        kernels.update_outward(links, segments, work)
        for s, p in enumerate(parents):
            information, vector = told["own"][s].copy(), told["own_vector"][s].copy()
            if p >= 0 and np.trace(told["cc"][s]) > 0.0:
                one, x_p = told[s], work.segments[p].x[:3]
                known_p = np.linalg.inv(np.linalg.inv(segments[p].P[:3, :3]) + one["pp"])
                gain = one["cp"] @ known_p
                information[:3, :3] += one["cc"] - gain @ one["cp"].T  # (52)
                vector[:3] += one["c"] - one["cp"] @ x_p - gain @ (one["p"] - one["pp"] @ x_p)  # (53)
            if np.trace(information) > 0.0 and np.trace(P[s]) > 0.0:
                self.compared["outward"] += 1
                after = np.linalg.solve(np.eye(6) + P[s] @ information, P[s])
                assert_close(segments[s].P, after)
                np.testing.assert_allclose(work.segments[s].x, after @ vector, rtol=1e-5, atol=1e-9)

    def note_corrections(self, state, tuning, work, dt):
        before = state.segments.copy()
        kernels.note_corrections(state, tuning, work, dt)
        was = [one.corrections for one in before]
        for s, now in enumerate(work.segments):
            after, c = state.segments[s].corrections, was[s].sums + now.x[:2]
            if after.seconds != 0.0 or was[s].seconds + dt < tuning.correction_block_s:
                continue
            self.compared["corrections"] += 1
            gain = 1.0 - np.exp(-(was[s].seconds + dt) / tuning.correction_memory_s)
            c_b, gamma, theta = was[s].sums_before, was[s].product, was[s].square
            gamma = gamma + gain * (c @ c_b - gamma)  # (58)
            theta = theta + gain * (0.5 * (c @ c + c_b @ c_b) - theta)
            change = tuning.correction_gain * gamma / theta  # (59)
            assert after.gyroscope == pytest.approx(np.clip(was[s].gyroscope + change, 0.0, 1.0))  # (60)
            assert after.rows == pytest.approx(np.clip(was[s].rows - change, 0.0, 1.0))  # (61)

    def define_headings(self, body, state, tuning):
        was, parents = state.segments.copy(), body.segments["parent"]
        kernels.define_headings(body, state, tuning)
        if (state.segments["P"] == was["P"]).all():
            return
        self.compared["defined"] += 1
        is_there = was["started"] == Started.YES
        dense = dense_tree(parents, was["P"], was["C"])
        headings = np.zeros(len(dense))
        headings[2::6] = is_there
        T = np.eye(len(dense)) - 0.99 * np.outer(headings, headings / is_there.sum())  # (57a)
        after = T @ dense @ T.T
        for s in np.flatnonzero(is_there):
            assert_close(state.segments[s].P, blocks(after, s, s))
            if parents[s] >= 0 and is_there[parents[s]]:
                assert_close(state.segments[s].C, blocks(after, s, parents[s]))

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
        kernels.update_tree(links, segments, work)
        after = np.linalg.solve(np.eye(6 * n) + dense @ information, dense)
        x = (after @ vector).reshape(n, 6)
        for s, p in enumerate(parents):
            if np.trace(dense[6 * s : 6 * s + 6, 6 * s : 6 * s + 6]) > 0.0:
                self.compared["update"] += 1
                assert_close(work.segments[s].x, x[s])
                assert_close(segments[s].P, blocks(after, s, s))
                if p >= 0:
                    assert_close(segments[s].C, blocks(after, s, p))


CHECKED = {
    tree_step: (
        "predict", "average", "predict_velocities", "start_segments", "follow_sun", "stance_rows",
        "unaided_rows", "zero_rate_rows",
        "update_tree", "update_outward", "note_corrections", "define_headings", "follow_field",
        "turn_segments",
    ),
    rows: ("joint_row", "learn_joint_arms", "gather_heading"),
    devices: ("_fixed_row", "_moving_row", "find_local_pair"),
}  # fmt: skip
"""Kernels that are called by way of ``Checked``, by the modules whose kernels call them …"""
SEEN_THROUGH = {
    tree_step: ("step", "_advance", "advance", "joint_rows", "device_rows"),
    rows: ("_joint_row", "_learn_arms"),
}
"""… and those that are run as Python, so that they do."""
kernels = SimpleNamespace(
    **{name.lstrip("_"): getattr(module, name) for module, names in CHECKED.items() for name in names}
)

LEAST = {
    "predict": 4000, "coast": 500, "bridge": 20, "average": 4000, "bridged_average": 10, "vibration": 4000,
    "force_shock": 50, "rate_shock": 50,
    "start": 20, "joint_row": 500, "open_joint_row": 1000, "heading": 1000, "joint_arms": 200,
    "fixed_point": 150, "pair": 60, "device": 3, "open_device": 50, "stance": 250, "zero_rate_watch": 4000,
    "zero_rate": 1000, "unaided": 4000, "seen": 500, "sun": 60, "corrections": 20,
    "compass": 4000, "compass_turn": 4000, "clipped": 300, "made_up": 6, "after_gap": 3,
    "velocity": 4000,
}  # fmt: skip
"""How often each has to be compared over the chains: a reference that is hardly asked guards nothing."""
UPDATES = {
    JointReconstructor: {"update": 8000, "defined": 4},
    OutwardReconstructor: {"outward": 2500},
}
KNOWN_HEADINGS = (7002, 7005, 7012)
"""Chains that begin as if motion showed no headings: rows take them as known from the first frame on."""
SEEDS = (7000, 7002, 7003, 7005, 7007, 7012, 7021, 7023)


def disturbed(chain):
    """Frames with modules that fall silent for up to 1.2 s, sensors at the end of their range, and knocks."""
    rng, out = np.random.default_rng(chain.seed), []
    frames = sampled(chain.suit, chain.motion, chain.switches, chain.seed, chain.rate_hz)[:N_FRAMES]
    n = len(frames[0].status)
    silent, clipped = np.zeros((2, n), int)
    world = np.array([0.6, 0.48, 0.64])
    for k, frame in enumerate(frames):
        if k > N_FRAMES // 3:
            silent = np.where(rng.random(silent.shape) < 0.007, rng.choice([1, 4, 10, 120]), silent - 1)
            clipped = np.where(rng.random(clipped.shape) < 0.005, rng.choice([1, 10, 60]), clipped - 1)
        force = np.where(silent[:, None] > 0, np.nan, frame.specific_force)
        knocks = np.random.default_rng([chain.seed, k]).normal(0.0, 1.0, (2, n, 3))
        knocks[:, np.abs(knocks[0, :, 0]) < 2.5] = 0.0
        status = np.where(silent > 0, Status.MISSING, frame.status).astype(np.uint8)
        at_end = np.where(clipped > 0, Clipped.ANGULAR_RATE, 0).astype(np.uint8)
        # a module that sees the sun anywhere: the rows say what it tells, not whether it is there
        sun = SunSight(world, Rotation.random(n, random_state=k).apply(world), np.full(n, 0.03))
        has_sun = chain.seed % 2 == 0 and k % 3 > 0
        out.append(
            replace(
                frame,
                specific_force=force + 20.0 * knocks[0],
                angular_rate=frame.angular_rate + 3.0 * knocks[1],
                status=status,
                clipped=at_end,
                sun=sun if has_sun else None,
            )
        )
    return out


def standing(chain):
    """(T, n) seconds for which segments are said to stand: now and then, at random."""
    rng = np.random.default_rng([chain.seed, 1])
    stood = rng.random((N_FRAMES, chain.suit.skeleton.n_segments)) < 0.1
    return stood / chain.rate_hz


def compared(kind, seed, monkeypatch):
    """Return how often each step was compared on a chain."""
    chain, checked = drawn(seed), Checked()
    for module, names in CHECKED.items():
        for name in names:
            monkeypatch.setattr(module, name, getattr(checked, name.lstrip("_")))
    for module, names in SEEN_THROUGH.items():
        for name in names:
            monkeypatch.setattr(module, name, getattr(module, name).__wrapped__)
    monkeypatch.setattr("gateway.reconstruction.inertial.tree.reconstructor.advance", tree_step.advance)
    body = kind(chain.suit, 1.0 / chain.rate_hz)
    body._body.segments["stands"][::2] = 1
    if seed in KNOWN_HEADINGS:
        body._body.segments["heading_observable"] = 0
    body.update_many(disturbed(chain), standing(chain))
    return checked.compared


@pytest.mark.timeout(900)  # the outer steps run as plain Python, several times slower on a busy machine
@pytest.mark.parametrize("kind", UPDATES)
def test_every_step_is_that_of_the_dense_filter(kind, monkeypatch):
    total: Counter[str] = Counter()
    for seed in SEEDS if kind is JointReconstructor else SEEDS[:6]:
        with monkeypatch.context() as patch:
            try:
                total.update(compared(kind, seed, patch))
            except AssertionError as error:
                error.add_note(f"of chain {seed}")
                raise
    assert {what: n for what, n in (LEAST | UPDATES[kind]).items() if total[what] < n} == {}
