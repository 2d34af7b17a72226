"""The signed distance network: off-axis positional embedding and softplus MLP (paper section 4.1).

The spatial gradient is written out by hand. With a_l = W_l h_{l-1} + b_l, h_l = softplus(a_l) and
s = w . h_L + b, the chain rule gives u_L = softplus'(a_L) * w and u_l = softplus'(a_l) * (W_{l+1}^T u_{l+1}):
a second sweep of matrix products that is itself part of the forward graph. A loss on distance and gradient then
needs one ordinary backward pass, never a second derivative of the graph.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .errors import ConfigError
from .numbers import require_finite

SOFTPLUS_BETA = 100.0


@dataclass(frozen=True)
class NetworkConfig:
    """Size of the network. The defaults are the paper's text: 4 hidden layers of 256.

    Args:
        width: activations a hidden layer.
        hidden_layers: number of hidden layers. The paper's published results used 6 (`skip_layer=4`).
        skip_layer: the hidden layer (counted from 1) that gets the embedding again.
        frequency_octaves: L; frequencies are 2^0 .. 2^L.
        input_scale: world metres are multiplied by this before the embedding [1/m].
        output_scale: the raw output is multiplied by this to give metres.
    """

    width: int = 256
    hidden_layers: int = 4
    skip_layer: int = 3
    frequency_octaves: int = 5
    input_scale: float = 0.0594
    output_scale: float = 0.14

    def __post_init__(self) -> None:
        require_finite(self)
        if self.width < 1 or self.hidden_layers < 2 or self.frequency_octaves < 0:
            raise ConfigError(
                f"network needs width >= 1, hidden_layers >= 2 and frequency_octaves >= 0, got width={self.width}, "
                f"hidden_layers={self.hidden_layers}, frequency_octaves={self.frequency_octaves}"
            )
        if not 2 <= self.skip_layer <= self.hidden_layers:
            raise ConfigError(
                f"skip_layer must be one of the hidden layers 2..{self.hidden_layers}, got {self.skip_layer}"
            )


def icosahedron_directions() -> Float[Tensor, "21 3"]:
    """Unit vertices of a twice-tessellated icosahedron, one of each antipodal pair (Barron et al., 2021)."""
    golden = (1 + math.sqrt(5)) / 2
    corners = [
        (a, s * golden, 0.0) for a in (1.0, -1.0) for s in (1.0, -1.0)
    ]  # fmt: skip
    vertices = torch.tensor(
        [p for x, y, z in corners for p in ((x, y, z), (z, x, y), (y, z, x))], dtype=torch.float64
    )
    # Splitting every edge once adds its midpoint: 12 corners + 30 midpoints = 42 = 2 x 21.
    gap = torch.cdist(vertices, vertices)
    i, j = torch.where(torch.triu(torch.isclose(gap, torch.tensor(2.0, dtype=torch.float64)), diagonal=1))
    points = nn.functional.normalize(torch.cat([vertices, vertices[i] + vertices[j]]), dim=-1)
    # Of each antipodal pair keep the one whose first non-zero coordinate, read from z, is positive.
    key = torch.where(points[:, 2].abs() > 1e-9, points[:, 2], 0) * 4
    key = key + torch.where(points[:, 1].abs() > 1e-9, points[:, 1], 0) * 1e-3
    key = key + torch.where(points[:, 0].abs() > 1e-9, points[:, 0], 0) * 1e-6
    return points[key > 0].float()


class _SoftplusPair(torch.autograd.Function):
    """softplus(a) and its derivative sigmoid(beta a) in one node, saving only the derivative."""

    @staticmethod
    def forward(ctx, a: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        # Below -87 / beta the exponential is a denormal number, which is ten times slower on CPUs and is zero
        # to every purpose; the clamp keeps it out.
        scaled = (a * SOFTPLUS_BETA).clamp_(min=-30.0)
        slope = torch.sigmoid(scaled)
        # log(1 + e^x) = x - log(sigmoid(x)): one logarithm, where the library's softplus costs three times that.
        value = scaled.sub_(torch.log(slope)).div_(SOFTPLUS_BETA)
        ctx.save_for_backward(slope)
        return value, slope

    @staticmethod
    def backward(ctx, grad_value: Tensor, grad_slope: Tensor) -> Tensor:  # type: ignore[override]
        (slope,) = ctx.saved_tensors
        curvature = (1 - slope).mul_(SOFTPLUS_BETA)
        return curvature.mul_(grad_slope).add_(grad_value).mul_(slope)


class SDFNetwork(nn.Module):
    """f(x; theta): world points [m] to signed distance [m].

    Args:
        config: the size.
        origin: (3,) world point that becomes the network's zero [m]; the first camera position is a good one.
        generator: source of the random initial weights.
    """

    origin: Tensor
    directions: Tensor

    def __init__(
        self, config: NetworkConfig, origin: Tensor, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("origin", origin.detach().clone().float())
        self.register_buffer("directions", icosahedron_directions())
        embedding = self.embedding_size
        layers = []
        for layer in range(1, config.hidden_layers + 1):
            inputs = embedding if layer == 1 else config.width
            inputs += embedding if layer == config.skip_layer else 0
            layers.append(nn.Linear(inputs, config.width))
        layers.append(nn.Linear(config.width, 1))
        self.layers = nn.ModuleList(layers)
        for linear in layers:
            nn.init.xavier_normal_(linear.weight, generator=generator)
            spread = linear.in_features**-0.5
            nn.init.uniform_(linear.bias, -spread, spread, generator=generator)

    @property
    def embedding_size(self) -> int:
        """3 scaled coordinates, then a sine and a cosine for each direction and octave."""
        return 3 + 2 * len(self.directions) * (self.config.frequency_octaves + 1)

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance [m] alone."""
        embedding, _, _ = self._embed(points)
        hidden = embedding
        for index, layer in enumerate(self._hidden, start=1):
            if index == self.config.skip_layer:
                hidden = torch.cat([hidden, embedding], dim=-1)
            hidden, _ = _SoftplusPair.apply(layer(hidden))
        return self.layers[-1](hidden)[:, 0] * self.config.output_scale

    def distance_and_gradient(
        self, points: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
        """Signed distance [m] and its spatial gradient [1], both differentiable in the weights."""
        embedding, sines, cosines = self._embed(points)
        hidden, slopes = embedding, []
        for index, layer in enumerate(self._hidden, start=1):
            if index == self.config.skip_layer:
                hidden = torch.cat([hidden, embedding], dim=-1)
            hidden, slope = _SoftplusPair.apply(layer(hidden))
            slopes.append(slope)
        linears = self._linears
        out = linears[-1]
        distance = out(hidden)[:, 0] * self.config.output_scale

        sensitivity = slopes[-1] * (out.weight * self.config.output_scale)
        embedding_gradient: Tensor | None = None
        for index in range(self.config.hidden_layers, 1, -1):
            back = sensitivity @ linears[index - 1].weight
            if index == self.config.skip_layer:
                back, embedding_gradient = back.split([self.config.width, self.embedding_size], dim=-1)
            sensitivity = slopes[index - 2] * back
        first = sensitivity @ linears[0].weight
        embedding_gradient = first if embedding_gradient is None else embedding_gradient + first
        return distance, self._embedding_vjp(embedding_gradient, sines, cosines)

    @property
    def _linears(self) -> list[nn.Linear]:
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    @property
    def _hidden(self) -> list[nn.Linear]:
        return self._linears[:-1]

    def _embed(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """gamma(x) with the scaled coordinates in front, and its sines and cosines (n, octave, direction)."""
        scaled = (points - self.origin) * self.config.input_scale
        angle = scaled @ self.directions.T
        sine, cosine = torch.sin(angle), torch.cos(angle)
        sines, cosines = [sine], [cosine]
        # Octave by octave with the double-angle formulas: 2 products instead of 2 transcendental functions.
        for _ in range(self.config.frequency_octaves):
            sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
            sines.append(sine)
            cosines.append(cosine)
        return (
            torch.cat([scaled, *sines, *cosines], dim=-1),
            torch.stack(sines, dim=1),
            torch.stack(cosines, dim=1),
        )

    def _embedding_vjp(self, gradient: Tensor, sines: Tensor, cosines: Tensor) -> Tensor:
        """Pull a gradient with respect to gamma(x) back to world coordinates."""
        octaves, directions = sines.shape[1:]
        raw, by_sine, by_cosine = gradient.split([3, octaves * directions, octaves * directions], dim=-1)
        frequency = 2.0 ** torch.arange(octaves, device=gradient.device, dtype=gradient.dtype)
        by_angle = by_sine.view_as(sines) * cosines - by_cosine.view_as(sines) * sines
        along = torch.einsum("nod,o->nd", by_angle, frequency)
        return (raw + along @ self.directions) * self.config.input_scale
