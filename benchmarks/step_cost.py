"""What a training step costs, against double backward and against the floor its matrix products set.

    python -m benchmarks.step_cost

For each network size: CPU time a point of forward, spatial gradient and backward with the hand-derived gradient; the
same by automatic double differentiation; and the time the matrix products alone need at the rate this machine reaches
with large ones, measured in the same run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
import tyro
from torch import Tensor

from isdf import IsdfConfig, NetworkConfig
from isdf.network import SOFTPLUS_BETA, SDFNetwork


@dataclass(frozen=True)
class StepCost:
    """Measure the cost of a training step."""

    points: int = 4096
    """Points a step."""
    repeats: int = 10
    """Steps that are timed; the best counts."""


def main(options: StepCost) -> None:
    """Print one line a network."""
    torch.set_num_threads(1)
    rate = matrix_rate(options.repeats)
    print(f"large matrix products: {rate / 1e9:.0f} GFLOP/s on one core")
    print(
        f"{'network':>10} {'parameters':>10} {'ours':>9} {'double':>9} {'ratio':>6} {'floor':>9} {'ratio':>6}"
    )
    sizes = {
        "cpu preset": IsdfConfig().network,
        "4 x 128": NetworkConfig(width=128),
        "4 x 256": NetworkConfig(),
        "6 x 256": IsdfConfig.released().network,
    }
    for name, config in sizes.items():
        network = SDFNetwork(config, torch.zeros(3), torch.Generator().manual_seed(0))
        points = torch.randn(options.points, 3)
        ours = best(lambda n=network, p=points: hand_derived(n, p), options.repeats) / options.points
        double = best(lambda n=network, p=points: double_backward(n, p), options.repeats) / options.points
        floor = flops(network) / rate
        count = sum(p.numel() for p in network.parameters())
        print(
            f"{name:>10} {count:>10} {1e6 * ours:9.1f} {1e6 * double:9.1f} {double / ours:6.2f} "
            f"{1e6 * floor:9.1f} {ours / floor:6.2f}"
        )


def hand_derived(network: SDFNetwork, points: Tensor) -> None:
    """A loss on distance and gradient with the formulas of `isdf.network`."""
    distance, gradient = network.distance_and_gradient(points)
    _loss(distance, gradient).backward()


def double_backward(network: SDFNetwork, points: Tensor) -> None:
    """The same loss with the spatial gradient by autograd, differentiated again."""
    points = points.clone().requires_grad_(True)
    embedding, _, _ = network._embed(points)
    hidden = embedding
    for index, layer in enumerate(network._hidden, start=1):
        hidden = torch.cat([hidden, embedding], dim=-1) if index == network.config.skip_layer else hidden
        hidden = torch.nn.functional.softplus(layer(hidden), beta=SOFTPLUS_BETA)
    distance = network._linears[-1](hidden)[:, 0] * network.config.output_scale
    (gradient,) = torch.autograd.grad(distance.sum(), points, create_graph=True)
    _loss(distance, gradient).backward()


def _loss(distance: Tensor, gradient: Tensor) -> Tensor:
    return distance.abs().mean() + (gradient.norm(dim=-1) - 1).abs().mean()


def flops(network: SDFNetwork) -> float:
    """Of the matrix products a point: value, gradient, and for each of them two products backwards.

    The first layer's input needs no gradient of the loss through the value, only through the gradient sweep.
    """
    sizes = [layer.weight.numel() for layer in network._linears]
    return 2.0 * (6 * sum(sizes) - sizes[0])


def matrix_rate(repeats: int) -> float:
    """FLOP/s of a large single-precision product on one core."""
    a, b = torch.randn(2048, 1024), torch.randn(1024, 1024)
    return 2 * 2048 * 1024 * 1024 / best(lambda: a @ b, repeats)


def best(work: Callable[[], object], repeats: int) -> float:
    """Least CPU time of a few runs [s]."""
    times = []
    for _ in range(repeats + 1):
        before = time.process_time()
        work()
        times.append(time.process_time() - before)
    return min(times[1:])


if __name__ == "__main__":
    main(tyro.cli(StepCost))
