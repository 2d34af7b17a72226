"""The one finite-difference check that every analytic gradient in the project goes through."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def assert_gradient_matches(
    value: Callable[[Tensor], Tensor],
    gradient: Callable[[Tensor], Tensor],
    at: Tensor,
    step: float = 1e-5,
    rtol: float = 1e-4,
    atol: float = 1e-6,
) -> None:
    """Compare an analytic gradient with central differences, in float64.

    Args:
        value: maps a tensor of the shape of `at` to a scalar.
        gradient: maps the same tensor to a tensor of the same shape, d value / d at.
        at: where to compare; converted to float64.
        step: half width of the central difference, in the units of `at`.
        rtol: allowed relative error of each component.
        atol: allowed absolute error of each component.
    """
    at = at.detach().double()
    numeric = torch.zeros_like(at)
    for i in range(at.numel()):
        offset = torch.zeros_like(at).view(-1)
        offset[i] = step
        offset = offset.view_as(at)
        numeric.view(-1)[i] = (value(at + offset) - value(at - offset)) / (2 * step)
    torch.testing.assert_close(gradient(at).double(), numeric, rtol=rtol, atol=atol)
