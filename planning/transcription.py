"""Refining a motion as a nonlinear programme: wheels, limits and time exact, clearances linearised (casadi)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from planning.linear_clearance import OBSTACLE_ROWS, SELF_ROWS, Clearances

ROWS = OBSTACLE_ROWS + SELF_ROWS
IPOPT: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    # The adaptive barrier halves the iterations of the default one; constraints are kept a hundred times better than
    # the cost.
    "ipopt": {
        "print_level": 0,
        "sb": "yes",
        "mu_strategy": "adaptive",
        "tol": 1e-5,
        "constr_viol_tol": 1e-9,
        "max_iter": 100,
    },
}


@dataclass(frozen=True)
class DriveLimits:
    """Limits of a motion, one entry a joint; the base's x entry stands for driving, its yaw entry for turning.

    Args:
        lower: joint limits [rad | m].
        upper: joint limits [rad | m].
        velocity: [rad/s | m/s].
        acceleration: [rad/s^2 | m/s^2].
        reverse: fastest driving backwards [m/s].
    """

    lower: Float[ndarray, " dof"]
    upper: Float[ndarray, " dof"]
    velocity: Float[ndarray, " dof"]
    acceleration: Float[ndarray, " dof"]
    reverse: float


@dataclass(frozen=True)
class Iterate:
    """Waypoints, signed distances driven [m] on each segment, and the time of a segment [s]."""

    q: Float[ndarray, "n dof"]
    driven: Float[ndarray, " segments"]
    step: float


class Transcription:
    """Direct transcription with evenly timed states; built once for a number of segments.

    The unknowns are the states, the signed distance s driven on every segment, the time h of a segment and a slack of
    each segment's clearances. A segment keeps the wheels' rule by the midpoint: the base moves by
    s (cos m, sin m), m the mean of its yaws before and after. With distances and joint steps in the place of
    velocities, velocity limits are linear, |dq| <= v h, and acceleration limits are |ddq| <= a h^2, from rest to rest.

    Args:
        segments: between the states.
        base: columns of base x, y and yaw; empty for a robot that does not drive.
        limits: of the joints.
        smoothness: weight [s] of squared accelerations, as shares of their limits, against time.
        slack_cost: [s/m] of penetrating a margin.
    """

    def __init__(
        self, segments: int, base: Sequence[int], limits: DriveLimits, smoothness: float, slack_cost: float
    ) -> None:
        self._limits, self._segments, self._base = limits, segments, tuple(base)
        dof = len(limits.velocity)
        q, driven = casadi.SX.sym("q", dof, segments + 1), casadi.SX.sym("s", segments)
        step, slack = casadi.SX.sym("h"), casadi.SX.sym("t", segments)
        steps, v_max, a_max = self._steps(q, driven)
        rest = casadi.SX(steps.shape[0], 1)
        changes = casadi.diff(casadi.horzcat(rest, steps, rest), 1, 1)
        # A step from or to rest has half a segment's time to change its speed.
        scale = np.r_[0.5, np.ones(segments - 1), 0.5] * a_max[:, None]
        reference = casadi.SX.sym("r", dof, segments + 1)
        share = casadi.SX.sym("w", segments)
        gap, rows = casadi.SX.sym("c", ROWS, 2 * segments), casadi.SX.sym("j", ROWS * dof, 2 * segments)
        moved = q - reference
        cleared = []
        for k in range(segments):
            within = (1 - share[k]) * moved[:, k] + share[k] * moved[:, k + 1]
            for i, change in ((k, moved[:, k]), (segments + k, within)):
                cleared.append(gap[:, i] + casadi.reshape(rows[:, i], ROWS, dof) @ change + slack[k])
        fastest = casadi.repmat(v_max * step, 1, segments)
        self._groups = (
            (self._wheels(q, driven), 0.0, 0.0),
            (casadi.vec(steps - fastest), -np.inf, 0.0),
            (casadi.vec(steps + fastest), 0.0, np.inf),
            (casadi.vec(changes - scale * step**2), -np.inf, 0.0),
            (casadi.vec(changes + scale * step**2), 0.0, np.inf),
            (driven + limits.reverse * step, 0.0, np.inf),
            (casadi.vertcat(*cleared), 0.0, np.inf),
        )
        # Smoothness is measured in the last iterate's time, which keeps it convex.
        before = casadi.SX.sym("h0")
        effort = casadi.sumsqr(changes / (scale * before**2)) * before
        cost = segments * step + smoothness * effort + slack_cost * casadi.sum1(slack)
        programme = {
            "x": casadi.vertcat(casadi.vec(q), driven, step, slack),
            "p": casadi.vertcat(casadi.vec(reference), casadi.vec(gap), casadi.vec(rows), share, before),
            "f": cost,
            "g": casadi.vertcat(*(g for g, _, _ in self._groups)),
        }
        self._solver = casadi.nlpsol("refine", "ipopt", programme, IPOPT)
        self._bounds = [np.concatenate([np.full(g[0].numel(), g[i]) for g in self._groups]) for i in (1, 2)]
        self._cost = casadi.Function(
            "cost", [q, driven, step, before], [segments * step + smoothness * effort]
        )

    def solve(self, last: Iterate, clearances: Clearances, radius: float) -> Iterate | None:
        """The best motion within a trust region about the last one; None where the solver fails or a clearance is NaN.

        Args:
            last: start and goal are taken from it.
            clearances: linearised at it.
            radius: most that a joint may move away from it [rad | m].
        """
        if np.isnan(clearances.gap).any():
            return None
        limits, n, dof = self._limits, self._segments + 1, last.q.shape[1]
        low, high = np.maximum(limits.lower, last.q - radius), np.minimum(limits.upper, last.q + radius)
        for end in (0, -1):
            low[end] = high[end] = last.q[end]
        free = np.full(self._segments, np.inf)
        slack = np.maximum(0.0, -clearances.gap.min(axis=(0, 2)))
        rows = clearances.rows.swapaxes(2, 3)  # column by column, as casadi reshapes
        solution = self._solver(
            x0=np.r_[last.q.ravel(), last.driven, last.step, slack],
            p=np.r_[last.q.ravel(), clearances.gap.ravel(), rows.ravel(), clearances.share, last.step],
            lbx=np.r_[low.ravel(), -free, 0.3 * last.step, 0 * slack],
            ubx=np.r_[high.ravel(), free, 3.0 * last.step, free],
            lbg=self._bounds[0],
            ubg=self._bounds[1],
        )
        if not self._solver.stats()["success"]:
            return None
        x = np.asarray(solution["x"]).ravel()
        return Iterate(x[: n * dof].reshape(n, dof), x[n * dof : n * dof + n - 1], float(x[n * dof + n - 1]))

    def cost(self, motion: Iterate, before: float) -> float:
        """Time and effort [s], the latter in the time `before` of a segment [s]."""
        return float(self._cost(motion.q.T, motion.driven, motion.step, before))

    def _steps(self, q: casadi.SX, driven: casadi.SX) -> tuple[casadi.SX, ndarray, ndarray]:
        """What velocity and acceleration limits bound, by segments: the distance driven for x and y."""
        joints = [j for j in range(q.shape[0]) if j not in self._base[:2]]
        parts = [casadi.diff(q[joints, :], 1, 1)]
        if self._base:
            parts.append(driven.T)
            joints.append(self._base[0])
        return casadi.vertcat(*parts), self._limits.velocity[joints], self._limits.acceleration[joints]

    def _wheels(self, q: casadi.SX, driven: casadi.SX) -> casadi.SX:
        """The base's motion minus what wheels can do, by segments."""
        if not self._base:
            return driven
        x, y, yaw = (q[j, :].T for j in self._base)
        heading = (yaw[:-1] + yaw[1:]) / 2
        return casadi.vertcat(
            casadi.diff(x) - driven * casadi.cos(heading), casadi.diff(y) - driven * casadi.sin(heading)
        )
