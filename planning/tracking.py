"""Drive a differential-drive base along a path by model-predictive control (needs casadi)."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from planning.errors import ConfigError, TrajectoryError
from planning.numbers import refuse_nan
from planning.path_reference import MotionLimits, PathReference, wrapped
from planning.unicycle_mpc import MpcWeights, UnicycleMpc

logger = logging.getLogger(__name__)

# A base slower than this [m/s and rad/s], for so many periods in a row, is at rest.
RESTING, RESTS = np.array([0.005, 0.01]), 3
# Where it rests it leaves out this much [m] of the path that lies ahead.
SKIPPED = 0.1


@dataclass(frozen=True)
class TrackerConfig:
    """Limits of the base and of the controller.

    Args:
        max_speed: forwards [m/s].
        max_reverse: backwards [m/s], for small corrections only.
        max_yaw_rate: [rad/s].
        max_acceleration: [m/s^2].
        max_yaw_acceleration: [rad/s^2].
        cruise_speed: speed [m/s] along a path without times.
        horizon: steps looked ahead.
        period: [s] between two commands, and of a step of the horizon.
        turn_threshold: heading error [rad] from which the base stops and turns on the spot.
        turn_done: heading error [rad] below which it drives on.
        position_tolerance: [m] to the end of the path at which the base has arrived.
        yaw_tolerance: [rad] for a final yaw.
        weights: of the errors of the controller.
    """

    max_speed: float = 0.6
    max_reverse: float = 0.15
    max_yaw_rate: float = 1.2
    max_acceleration: float = 0.6
    max_yaw_acceleration: float = 2.0
    cruise_speed: float = 0.4
    horizon: int = 15
    period: float = 0.1
    turn_threshold: float = math.radians(60)
    turn_done: float = math.radians(10)
    position_tolerance: float = 0.02
    yaw_tolerance: float = 0.03
    weights: MpcWeights = field(default_factory=MpcWeights)

    def __post_init__(self) -> None:
        refuse_nan(self)
        positive = (
            self.max_speed,
            self.max_yaw_rate,
            self.max_acceleration,
            self.max_yaw_acceleration,
            self.period,
        )
        if min(positive) <= 0 or self.max_reverse < 0 or self.horizon < 2:
            raise ConfigError(
                f"TrackerConfig: limits and period must be positive and horizon >= 2, got {self}."
            )
        if not 0 < self.cruise_speed <= self.max_speed:
            raise ConfigError(
                f"TrackerConfig: cruise_speed must be in (0, max_speed], got {self.cruise_speed:g} "
                f"with max_speed {self.max_speed:g} m/s."
            )


class BaseTracker:
    """Follows one path at a time; `command` is called once a period.

    Far off the heading it turns on the spot; along the path it solves a small optimal-control problem for the
    unicycle x' = v cos(yaw), y' = v sin(yaw), yaw' = omega; at the end it turns to the final yaw if one is
    asked for.
    """

    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.config = config = config or TrackerConfig()
        self._controller = UnicycleMpc(
            config.horizon,
            config.period,
            lowest=(-config.max_reverse, -config.max_yaw_rate),
            highest=(config.max_speed, config.max_yaw_rate),
            accelerations=(config.max_acceleration, config.max_yaw_acceleration),
            weights=config.weights,
        )
        self.reset()

    def reset(self) -> None:
        """Forget the path, the progress on it and the last command (the base is at rest)."""
        self._reference: PathReference | None = None
        self._key: object = None
        self._last = np.zeros(2)
        self._controller.reset()
        self._turning = False
        self._arrived = False
        self._rested = 0
        self.finished = False

    def command(
        self,
        state: Float[ndarray, " 3"],
        path: Float[ndarray, "n 2"],
        times: Float[ndarray, " n"] | None = None,
        final_yaw: float | None = None,
    ) -> tuple[float, float]:
        """The next command (v [m/s], omega [rad/s]), to be held for one period.

        Args:
            state: x, y [m], yaw [rad] of the base in the world.
            path: positions [m]; where another path is given than last time, tracking starts afresh on it
                (the last command is kept, so speeds stay continuous).
            times: [s] of the positions, strictly increasing: sets the speed along the path. Without them the
                base drives at `cruise_speed`. Either way it brakes before the end.
            final_yaw: [rad] to turn to after arriving.

        Returns:
            v and omega. (0, 0) with `finished` set once position and yaw are reached.

        Raises:
            TrajectoryError: if the path or its times are malformed or the state is not finite.
        """
        config = self.config
        if not np.isfinite(state).all():
            raise TrajectoryError(f"BaseTracker: state must be finite, got {state.tolist()}.")
        reference = self._follow(path, times)
        reference.advance(state[:2])
        error = math.hypot(*(reference.end - state[:2]))
        # Once arrived, turning in place must not be called off by a little drift.
        tolerance = (2 if self._arrived else 1) * config.position_tolerance
        self._arrived = reference.near_end and error <= tolerance
        if self._arrived:
            turn = 0.0 if final_yaw is None else wrapped(final_yaw - float(state[2]))
            done = abs(turn) <= config.yaw_tolerance
            command = self._on_the_spot(0.0 if done else turn)
            self.finished = done and not command.any()
            return self._send(command)
        self.finished = False
        close = error < 5 * config.position_tolerance
        if self._rests():
            # No optimum of the horizon leads sideways: turn to what lies ahead and drive there.
            self._reference = reference = self._along(np.vstack([state[:2], reference.ahead(SKIPPED)]), None)
            self._turning = True
        heading = wrapped(reference.heading() - float(state[2]))
        behind = not self._turning and close and reference.past_end(state[:2])
        self._turning = not behind and abs(heading) > (
            config.turn_done if self._turning else config.turn_threshold
        )
        if self._turning:
            return self._send(self._on_the_spot(heading))
        return self._send(self._optimal(state, reference))

    def overruled(self, v: float, omega: float) -> None:
        """Go on from (v [m/s], omega [rad/s]), which was sent in the place of the last command."""
        self._last = np.array([v, omega])
        self._rested = 0

    def _follow(self, path: Float[ndarray, "n 2"], times: Float[ndarray, " n"] | None) -> PathReference:
        key = (path.tobytes(), None if times is None else times.tobytes())
        if self._reference is None or key != self._key:
            self._reference = self._along(path, times)
            self._key, self._turning, self._arrived, self._rested = key, False, False, 0
        return self._reference

    def _along(self, path: Float[ndarray, "n 2"], times: Float[ndarray, " n"] | None) -> PathReference:
        config = self.config
        # The reference keeps below the limits, so that errors can be made up for.
        motion = MotionLimits(config.max_speed, 0.7 * config.max_acceleration, 0.7 * config.max_yaw_rate)
        return PathReference(path, times, config.cruise_speed, motion)

    def _rests(self) -> bool:
        """Whether the base has stood for some periods, of its own accord, before it has arrived."""
        resting = not self._turning and bool((np.abs(self._last) < RESTING).all())
        self._rested = self._rested + 1 if resting else 0
        if self._rested < RESTS:
            return False
        self._rested = 0
        return True

    def _send(self, command: Float[ndarray, " 2"]) -> tuple[float, float]:
        self._last = command
        return float(command[0]), float(command[1])

    def _on_the_spot(self, turn: float) -> Float[ndarray, " 2"]:
        """Brake, and turn by an angle as fast as can be stopped in time."""
        config = self.config
        stoppable = math.sqrt(2 * 0.7 * config.max_yaw_acceleration * abs(turn))
        wanted = math.copysign(min(config.max_yaw_rate, stoppable, abs(turn) / (2 * config.period)), turn)
        return self._within_accelerations(np.array([0.0, wanted]))

    def _within_accelerations(self, command: Float[ndarray, " 2"]) -> Float[ndarray, " 2"]:
        change = (
            np.array([self.config.max_acceleration, self.config.max_yaw_acceleration]) * self.config.period
        )
        return np.clip(command, self._last - change, self._last + change)

    def _optimal(self, state: Float[ndarray, " 3"], reference: PathReference) -> Float[ndarray, " 2"]:
        """First input of the optimal plan over the horizon; brakes where the solver fails."""
        target = reference.horizon(self.config.horizon, self.config.period, float(state[2]))
        inputs = self._controller.solve(state, self._last, target)
        if inputs is None:
            logger.warning("the tracking problem was not solved; braking")
            return self._within_accelerations(np.zeros(2))
        return self._within_accelerations(inputs)
