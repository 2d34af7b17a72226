"""What computing costs the robot's clock."""

from __future__ import annotations

import time

import pytest

from planning import ConfigError
from planning.clock import FixedClock, MeasuredClock
from tests.planning.fields import HalfSpace
from tests.planning.unicycles import TaughtMap


def mapper() -> TaughtMap:
    fresh = TaughtMap(HalfSpace())
    fresh.integrate("frame")
    return fresh


def busy(seconds: float) -> str:
    ends = time.process_time() + seconds
    while time.process_time() < ends:
        pass
    return "done"


def test_measured_cost_is_cpu_time_not_waiting() -> None:
    clock = MeasuredClock()
    result, spent = clock.charge(lambda: busy(0.1))
    assert result == "done" and 0.1 <= spent < 0.3
    _, idle = clock.charge(lambda: time.sleep(0.2))
    assert 0 <= idle < 0.1


def test_measured_training_runs_for_the_time_and_is_charged_what_it_took() -> None:
    class Slow(TaughtMap):
        def run_for(self, cpu_seconds: float) -> int:
            busy(2 * cpu_seconds)
            return super().run_for(cpu_seconds)

    slow = Slow(HalfSpace())
    slow.integrate("frame")
    spent = MeasuredClock(training=0.05).train(slow)
    assert slow.asked == 0.05, "the map is given the configured time"
    assert 0.1 <= spent < 0.3, "and charged the time it took"


def test_fixed_cost_does_not_depend_on_the_machine() -> None:
    clock, map_ = FixedClock(steps=7, training=0.3, planning=0.2), mapper()
    assert clock.train(map_) == 0.3 and map_.steps == 7 and map_.asked == 0
    assert clock.charge(lambda: busy(0.01)) == ("done", 0.2)


@pytest.mark.parametrize("clock", [MeasuredClock(), FixedClock()])
def test_errors_pass_through(clock) -> None:
    with pytest.raises(ZeroDivisionError):
        clock.charge(lambda: 1 / 0)


@pytest.mark.parametrize("values", [{"steps": 0}, {"training": -0.1}, {"planning": -0.1}])
def test_bad_fixed_costs_are_refused(values: dict) -> None:
    with pytest.raises(ConfigError, match="FixedClock"):
        FixedClock(**values)


@pytest.mark.parametrize("training", [0.0, -1.0])
def test_bad_training_times_are_refused(training: float) -> None:
    with pytest.raises(ConfigError, match="MeasuredClock"):
        MeasuredClock(training=training)
