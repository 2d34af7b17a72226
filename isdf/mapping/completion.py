"""The network that guesses distances between what the views prove: a small 3D U-Net over a coarse lattice.

Its answer can only lie between the bounds, f = upper - (upper - lower) * share with share in (0, 1), so where the
bounds meet it has nothing to say. With the distance it gives the error it expects of it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn

from .evidence import Evidence

CHANNELS = 8
# A window's sides must be multiples of this many nodes: the network halves them three times.
STRIDE = 8
REACH = 3.0
WEIGHTS = Path(__file__).parent.parent / "data" / "completion.safetensors"


def features(evidence: Evidence) -> Float[Tensor, "8 nx ny nz"]:
    """What the network sees of each node: bounds, state, direction to the closest surface, height."""
    shape = evidence.upper.shape
    planes = [
        np.minimum(evidence.upper, REACH),
        np.clip(evidence.lower, -2, 2),
        evidence.free,
        evidence.unknown,
        *np.moveaxis(evidence.direction, -1, 0),
        np.broadcast_to(np.clip(evidence.height, -2, 4), shape),
    ]
    return torch.from_numpy(np.stack([p.astype(np.float32) for p in planes]))


class CompletionNet(nn.Module):
    """Share of the gap between the bounds, and the expected error as a share of the gap (its logarithm)."""

    def __init__(self) -> None:
        super().__init__()

        def conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
            return nn.Sequential(nn.Conv3d(inputs, outputs, 3, stride, 1), nn.LeakyReLU(0.1))

        self.down1 = nn.Sequential(conv(CHANNELS, 16, 2), conv(16, 32))
        self.down2 = nn.Sequential(conv(32, 64, 2), conv(64, 64))
        self.down3 = nn.Sequential(conv(64, 96, 2), conv(96, 96), conv(96, 96), conv(96, 96))
        self.rise2, self.rise1, self.rise0 = nn.Conv3d(96, 64, 1), nn.Conv3d(64, 32, 1), nn.Conv3d(32, 32, 1)
        self.up2 = nn.Sequential(conv(64 + 64, 64), conv(64, 64))
        self.up1 = conv(32 + 32, 32)
        self.local = nn.Conv3d(CHANNELS, 32, 1)
        self.head = nn.Sequential(
            nn.LeakyReLU(0.1), nn.Conv3d(32, 32, 1), nn.LeakyReLU(0.1), nn.Conv3d(32, 2, 1)
        )

    def forward(
        self, x: Float[Tensor, "b 8 nx ny nz"]
    ) -> tuple[Float[Tensor, "b nx ny nz"], Float[Tensor, "b nx ny nz"]]:
        """Share in (0, 1) and logarithm of the expected error over the gap."""
        one = self.down1(x)
        two = self.down2(one)
        three = self.down3(two)
        two = self.up2(torch.cat([_twice(self.rise2(three)), two], dim=1))
        one = self.up1(torch.cat([_twice(self.rise1(two)), one], dim=1))
        # It may be trained in half precision, which has too few digits for shares near 0 and 1.
        out = self.head(_twice(self.rise0(one)) + self.local(x)).float()
        return torch.sigmoid(out[:, 0]), out[:, 1].clamp(-6, 1)


def _twice(x: Tensor) -> Tensor:
    return nn.functional.interpolate(x, scale_factor=2, mode="trilinear", align_corners=False)


def load_network() -> CompletionNet:
    """The trained network that comes with the package; see benchmarks/train_completion.py."""
    network = CompletionNet()
    network.load_state_dict({name: values.float() for name, values in load_file(WEIGHTS).items()})
    return network.eval().requires_grad_(False)
