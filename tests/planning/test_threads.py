"""Planning uses one thread of PyTorch's and gives the others back."""

from __future__ import annotations

import pytest
import torch

from planning import Chomp, Planner, Trajectory
from tests.planning.fields import Cylinder
from tests.planning.robots import Disc


class Watched:
    """A field that notes how many threads its queries may use, and fails on demand."""

    def __init__(self, field, fails: bool = False) -> None:
        self.field, self.fails, self.threads = field, fails, set()

    def distance(self, points):
        self.threads.add(torch.get_num_threads())
        if self.fails:
            raise RuntimeError("no map")
        return self.field.distance(points)

    def distance_and_gradient(self, points):
        self.threads.add(torch.get_num_threads())
        return self.field.distance_and_gradient(points)


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("fails", [False, True])
def test_one_thread_while_planning_and_all_after_it(two_threads, fails: bool) -> None:
    field = Watched(Cylinder((1.0, 0.1), 0.3), fails)
    start, goal = torch.tensor([0.0, 0.0]), torch.tensor([2.0, 0.0])
    for plan in (
        lambda: Chomp(Disc()).optimise(Trajectory.line(start, goal, 20), field),
        lambda: Planner(Disc()).plan(start, goal, field),
    ):
        if fails:
            with pytest.raises(RuntimeError, match="no map"):
                plan()
        else:
            assert plan().success
        assert field.threads == {1}
        assert torch.get_num_threads() == 2
