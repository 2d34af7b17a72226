import pytest
import torch

from planning import Chomp, ChompConfig, ObjectiveConfig, Trajectory
from planning.hamiltonian import shaken
from planning.metric import Metric
from planning.objective import Objective
from planning.workspace import Workspace
from tests.planning.fields import Cylinder, Sphere, Union
from tests.planning.robots import Disc

FAR = Sphere((50.0, 0.0, 0.0), 1.0)


def _objective(n=20, smoothness_weight=0.0, field=FAR):
    robot = Disc()
    config = ObjectiveConfig(smoothness_weight=smoothness_weight)
    return Objective(robot, Workspace(robot, field, eps=0.1), Metric(n), config)


def _shaken(objective, q, temperature, seed=0, steps=8):
    generator = torch.Generator().manual_seed(seed)
    return shaken(objective, q, temperature, generator, lambda x: x, steps)


def test_noise_has_the_covariance_of_the_metric():
    metric = Metric(8)
    white = torch.randn(40_000, 6, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noise = metric.smooth_noise(white)[..., 0]
    torch.testing.assert_close(noise.T @ noise / len(noise), metric.inverse, rtol=0, atol=0.03)


def test_ends_stay_and_the_seed_decides():
    objective, q = _objective(), torch.zeros(3, 20, 2)
    first, again, other = (_shaken(objective, q, 0.1, seed) for seed in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert (first[:, [0, -1]] == 0).all() and (first[:, 1:-1] != 0).any()
    assert not torch.equal(first[0], first[1])  # every trajectory of a batch gets its own momentum
    assert (q == 0).all()


def test_without_forces_motion_is_even_and_grows_with_the_root_of_the_temperature():
    objective, q = _objective(), torch.zeros(1, 20, 2, dtype=torch.float64)
    once = _shaken(objective, q, 1e-3, steps=1)
    torch.testing.assert_close(_shaken(objective, q, 1e-3, steps=5), 5 * once)
    torch.testing.assert_close(_shaken(objective, q, 4e-3, steps=1), 2 * once)


def test_a_shaken_trajectory_is_smooth():
    objective, q = _objective(), torch.zeros(1, 20, 2, dtype=torch.float64)
    moved = _shaken(objective, q, 1e-2)[0]
    assert float(moved.diff(dim=0).abs().max()) < 0.5 * float(moved.abs().max())


def test_energy_is_kept_by_the_leapfrog_steps():
    """In the smoothness alone, a harmonic oscillator, kinetic and potential energy add up to the same."""
    objective = _objective(smoothness_weight=1.0)
    q = torch.zeros(1, 20, 2, dtype=torch.float64)
    stride, energies = 0.3, []
    path = [q] + [_shaken(objective, q, 1e-2, steps=k) for k in range(1, 9)]
    for before, here, after in zip(path, path[1:], path[2:], strict=False):
        momentum = (after - before)[:, 1:-1] / (2 * stride)
        kinetic = 0.5 * (momentum * torch.linalg.solve(objective.metric.inverse, momentum)).sum()
        energies.append(float(kinetic + objective(here).total))
    assert max(energies) < 1.05 * min(energies)


def test_restarts_leave_a_local_minimum():
    """Three poles in a row catch the trajectory between them; without momentum it stays there."""
    field = Union(Cylinder((1.0, 0.0), 0.35), Cylinder((1.0, 0.62), 0.3), Cylinder((1.0, -0.62), 0.3))
    line = Trajectory.through(torch.tensor([[0.0, 0.0], [1.0, 0.33], [2.0, 0.0]]), 30)
    alone = Chomp(Disc(), ChompConfig(max_tightenings=1, restarts=0)).optimise(line, field)
    helped = Chomp(Disc(), ChompConfig(max_tightenings=1, restarts=8, temperature=1.0)).optimise(line, field)
    assert not alone.success
    assert helped.success, helped.message


@pytest.mark.parametrize("temperature", [0.0])
def test_cold_trajectories_only_roll_downhill(temperature):
    field = Cylinder((1.0, 0.05), 0.3)
    objective = _objective(n=30, field=field)
    q = Trajectory.line(torch.zeros(2), torch.tensor([2.0, 0.0]), 30).waypoints[None]
    assert float(objective(_shaken(objective, q, temperature)).total) < float(objective(q).total)
