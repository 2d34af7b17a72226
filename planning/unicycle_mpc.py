"""The tracking problem of a unicycle following a reference; built once, solved each period (casadi)."""

from __future__ import annotations

from dataclasses import dataclass

import casadi
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from planning.errors import SolverError


@dataclass(frozen=True)
class MpcWeights:
    """Costs of squared errors: position [1/m^2], yaw [1/rad^2], inputs' changes; `final` times at the end."""

    position: float = 20.0
    yaw: float = 1.0
    effort: float = 0.2
    final: float = 5.0


class UnicycleMpc:
    """Least-squares tracking over a horizon, x' = v cos(yaw), y' = v sin(yaw), yaw' = omega, midpoint rule.

    The inputs are the unknowns. Each Gauss-Newton iteration linearises the errors and solves a convex
    quadratic programme with bounds on the inputs and on their change; the inputs of the last call, shifted,
    are its start.

    Args:
        steps: length of the horizon.
        period: [s] of a step.
        lowest: least v [m/s] and omega [rad/s].
        highest: greatest ones.
        accelerations: greatest change of each a second.
        weights: of the errors.
        iterations: Gauss-Newton iterations a call.
    """

    def __init__(
        self,
        steps: int,
        period: float,
        lowest: tuple[float, float],
        highest: tuple[float, float],
        accelerations: tuple[float, float],
        weights: MpcWeights | None = None,
        iterations: int = 2,
    ) -> None:
        self._steps, self._iterations = steps, iterations
        self._low, self._high = np.tile(lowest, steps), np.tile(highest, steps)
        self._change = np.tile(accelerations, steps) * period
        inputs, state, last = casadi.SX.sym("u", 2, steps), casadi.SX.sym("x", 3), casadi.SX.sym("u0", 2)
        target = casadi.SX.sym("r", 3, steps)
        errors = _errors(inputs, state, last, target, period, weights or MpcWeights())
        unknowns = casadi.vec(inputs)
        jacobian = casadi.jacobian(errors, unknowns)
        step_cost = [jacobian.T @ jacobian, jacobian.T @ errors, casadi.dot(errors, errors)]
        self._linearise = casadi.Function("linearise", [inputs, state, last, target], step_cost)
        changes = np.eye(2 * steps) - np.eye(2 * steps, k=-2)
        self._changes = casadi.DM(casadi.sparsify(changes))
        shape = {"h": casadi.Sparsity.dense(2 * steps, 2 * steps), "a": self._changes.sparsity()}
        if not casadi.has_conic("daqp"):
            raise SolverError(
                "UnicycleMpc: this casadi comes without the solver 'daqp'; install casadi >= 3.7."
            )
        self._programme = casadi.conic("programme", "daqp", shape, {"error_on_fail": False})
        self.reset()

    def reset(self) -> None:
        """Forget the last solution."""
        self._inputs = np.zeros(2 * self._steps)

    def solve(
        self, state: Float[ndarray, " 3"], last: Float[ndarray, " 2"], target: Float[ndarray, "3 steps"]
    ) -> Float[ndarray, " 2"] | None:
        """The next input, or None if the programme could not be solved.

        Args:
            state: x, y [m], yaw [rad].
            last: the input in force, from which the change is bounded.
            target: x, y [m] and unwrapped yaw [rad] after each step.
        """
        inputs = np.r_[self._inputs[2:], self._inputs[-2:]]
        for _ in range(self._iterations):
            hessian, slope, _ = self._linearise(inputs.reshape(self._steps, 2).T, state, last, target)
            offset = self._changes @ inputs
            start = np.r_[last, np.zeros(2 * self._steps - 2)]
            solution = self._programme(
                h=hessian,
                g=slope,
                a=self._changes,
                lbx=self._low - inputs,
                ubx=self._high - inputs,
                lba=start - self._change - offset,
                uba=start + self._change - offset,
            )
            if not self._programme.stats()["success"]:
                self.reset()
                return None
            inputs = np.clip(inputs + np.asarray(solution["x"]).ravel(), self._low, self._high)
        self._inputs = inputs
        return inputs[:2].copy()


def _errors(
    inputs: casadi.SX,
    state: casadi.SX,
    last: casadi.SX,
    target: casadi.SX,
    period: float,
    weights: MpcWeights,
) -> casadi.SX:
    """Weighted errors of the predicted states and changes of the inputs, stacked."""
    errors = []
    for k in range(inputs.shape[1]):
        v, omega = inputs[0, k], inputs[1, k]
        middle = state[2] + 0.5 * period * omega
        state = state + period * casadi.vertcat(v * casadi.cos(middle), v * casadi.sin(middle), omega)
        factor = weights.final if k == inputs.shape[1] - 1 else 1.0
        errors.append((factor * weights.position) ** 0.5 * (state[:2] - target[:2, k]))
        errors.append((factor * weights.yaw) ** 0.5 * (state[2] - target[2, k]))
        errors.append(weights.effort**0.5 * (inputs[:, k] - last))
        last = inputs[:, k]
    return casadi.vertcat(*errors)
