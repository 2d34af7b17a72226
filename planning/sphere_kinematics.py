"""Where a robot's spheres are, and how forces on them pull at its joints: compiled where the robot allows it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from planning.protocols import CompilableRobot, SphereRobot


class TorchKinematics:
    """Any robot's spheres, pulled back by autograd."""

    def __init__(self, robot: SphereRobot) -> None:
        self._robot = robot

    def centres(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch s 3"]:
        """Sphere centres [m] at configurations q, without a graph."""
        with torch.no_grad():
            return self._robot.spheres(q)[0]

    def pull_back(
        self,
        q: Float[Tensor, "*batch dof"],
        centres: Float[Tensor, "*batch s 3"],
        forces: Float[Tensor, "*batch s 3"],
    ) -> Float[Tensor, "*batch dof"]:
        """J^T f: the gradient by the joints of a cost whose gradient by the sphere centres is `forces`."""
        states = q.detach().requires_grad_()
        with torch.enable_grad():
            (gradient,) = torch.autograd.grad(self._robot.spheres(states)[0], states, forces)
        return gradient


class CompiledKinematics(TorchKinematics):
    """The same through compiled kernels; ten times as fast and more."""

    def __init__(self, robot: CompilableRobot) -> None:
        from planning.compiled.arrays import chain_of

        super().__init__(robot)
        frame, rows = robot.placed_spheres
        self._chain = chain_of(robot)
        self._frame = np.ascontiguousarray(frame, np.int64)
        self._local = np.ascontiguousarray(rows[:, :3], np.float64)

    def centres(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch s 3"]:
        """Sphere centres [m] at configurations q, without a graph."""
        from planning.compiled.kinematics import sphere_centres

        flat = q.detach().reshape(-1, q.shape[-1]).double().numpy()
        centres = sphere_centres(self._chain, self._frame, self._local, flat)
        return torch.from_numpy(centres).to(q).view(*q.shape[:-1], -1, 3)

    def pull_back(
        self,
        q: Float[Tensor, "*batch dof"],
        centres: Float[Tensor, "*batch s 3"],
        forces: Float[Tensor, "*batch s 3"],
    ) -> Float[Tensor, "*batch dof"]:
        """J^T f, from the geometric Jacobian."""
        from planning.compiled.kinematics import pull_back

        flat = q.detach().reshape(-1, q.shape[-1]).double().numpy()
        points, pushes = (x.reshape(len(flat), -1, 3).double().numpy() for x in (centres, forces))
        return torch.from_numpy(pull_back(self._chain, self._frame, flat, points, pushes)).to(q).view(q.shape)


def kinematics_of(robot: SphereRobot) -> TorchKinematics:
    """The fastest kinematics that a robot offers."""
    if not isinstance(robot, CompilableRobot):
        return TorchKinematics(robot)
    return CompiledKinematics(robot)
