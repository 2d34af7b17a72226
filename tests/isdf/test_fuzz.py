"""A short turn of every fuzz property; `python -m tests.fuzz --minutes 30` takes longer ones."""

import pytest
from hypothesis import HealthCheck, settings

from tests.fuzz.__main__ import PROPERTIES
from tests.fuzz.accepts import OUTCOMES

ALL = [one for group in PROPERTIES.values() for one in group]
QUICK = settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


@pytest.mark.parametrize("prove", ALL, ids=lambda one: one.__name__)
def test_only_results_and_own_errors_come_out(prove) -> None:
    before = sum(OUTCOMES.values())
    QUICK(prove)()
    assert sum(OUTCOMES.values()) > before
