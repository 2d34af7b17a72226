"""The online mapper: posed depth images in, a signed distance field out (paper section 4)."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .bounds import BoundMethod, supervise
from .cost import CostField
from .display import ShownMapper
from .errors import ConfigError, DivergedError, FrameError, NotReadyError
from .extent import grown, nothing_seen
from .field import NeuralField
from .frames import DepthFrame
from .keyframes import KeyframeConfig, KeyframeSet, explained_share
from .losses import LossConfig, total_loss
from .network import NetworkConfig, SDFNetwork
from .numbers import require_finite
from .sampling import RayBatch, SamplingConfig, sample_rays


@dataclass(frozen=True)
class IsdfConfig:
    """Everything that shapes a map. `IsdfConfig()` runs on a CPU; `paper()` and `released()` are the original.

    The CPU preset is the same method with a narrower network and fewer, better-supervised samples: 20 rays a frame
    instead of 200, but the batch distance looks at 400 surface points of every frame, and the regions of the losses
    follow the bound, which that makes tight.

    Args:
        network: size of the network.
        sampling: pixels and samples a step.
        losses: weights and regions of the losses.
        keyframes: which frames are kept and replayed.
        bound: how the distance of a sample is bounded: "batch" (the paper's choice), "normal" or "ray".
        learning_rate: of AdamW.
        weight_decay: of AdamW.
        first_frame_steps: steps `integrate` runs on the first frame.
        steps_per_frame: steps `integrate` runs on every other frame; 0 leaves all training to `step`, `run_for`.
        keyframe_steps: further steps when a frame has become a keyframe.
        seed: of all random draws.
    """

    network: NetworkConfig = default(default_factory=lambda: NetworkConfig(width=64, input_scale=0.12))
    sampling: SamplingConfig = default(
        default_factory=lambda: SamplingConfig(
            rays_per_frame=20, stratified=8, near_surface=4, extra_surface=380, normal_step=2
        )
    )
    losses: LossConfig = default(
        default_factory=lambda: LossConfig(regions_by="bound", eikonal_weight=0.05, gradient_weight=0.1)
    )
    keyframes: KeyframeConfig = default(default_factory=lambda: KeyframeConfig(test_rays=200))
    bound: BoundMethod = "batch"
    learning_rate: float = 0.0013
    weight_decay: float = 0.012
    first_frame_steps: int = 40
    steps_per_frame: int = 10
    keyframe_steps: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        require_finite(self)
        if self.bound not in ("ray", "normal", "batch"):
            raise ConfigError(f"bound must be one of ray, normal, batch; got {self.bound!r}")
        if not self.learning_rate > 0 or self.weight_decay < 0:
            raise ConfigError(
                f"learning_rate must be positive and weight_decay zero or more, got {self.learning_rate} and "
                f"{self.weight_decay}"
            )
        if min(self.first_frame_steps, self.steps_per_frame, self.keyframe_steps) < 0:
            raise ConfigError("numbers of steps must be zero or more")

    @classmethod
    def paper(cls, **changes: Any) -> IsdfConfig:
        """The paper's text: 4 x 256, 200 rays a frame, 20 + 8 + 1 samples a ray. Seconds a step on a CPU."""
        full = cls(
            network=NetworkConfig(),
            sampling=SamplingConfig(),
            losses=LossConfig(),
            keyframes=KeyframeConfig(),
            first_frame_steps=200,
            steps_per_frame=10,
            keyframe_steps=60,
        )
        return replace(full, **changes)

    @classmethod
    def released(cls, **changes: Any) -> IsdfConfig:
        """The values behind the paper's published results: 6 hidden layers, 19 + 7 + 1 samples, tuned weights."""
        tuned = LossConfig(
            truncation=0.2937,
            surface_weight=5.383,
            gradient_weight=0.018,
            eikonal_weight=0.268,
            regions_by="bound",
            noise=0.04,
        )
        return cls.paper(
            network=NetworkConfig(hidden_layers=6, skip_layer=4),
            sampling=SamplingConfig(stratified=19, near_surface=7),
            losses=tuned,
            **changes,
        )


class IsdfMapper(ShownMapper):
    """Learns a signed distance field online.

    Call `integrate` with every new frame and, when there is time to spare, `step` or `run_for`; `field` gives an
    immutable snapshot at any moment.

    Args:
        config: see `MapperConfig`.
        device: where the network lives; the CPU is the reference.
    """

    def __init__(self, config: IsdfConfig | None = None, device: str | torch.device = "cpu") -> None:
        self.config = config or IsdfConfig()
        self.device = torch.device(device)
        self.keyframes = KeyframeSet()
        self.frames_seen = 0
        self.steps = 0
        self.generator = torch.Generator().manual_seed(self.config.seed)
        self._network: SDFNetwork | None = None
        self._frozen: SDFNetwork | None = None
        self._optimiser: torch.optim.AdamW | None = None
        self._newest: DepthFrame | None = None
        self._newest_judged = True
        self._bounds = nothing_seen()

    @property
    def network(self) -> SDFNetwork:
        """The live network, which training changes; NotReadyError before the first frame."""
        if self._network is None:
            raise NotReadyError("the map is empty: call mapper.integrate(frame) first")
        return self._network

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        """Lower and upper corner [m] of the surfaces and cameras seen so far; NotReadyError before the first."""
        if self._network is None:
            raise NotReadyError("nothing was seen yet: call mapper.integrate(frame) first")
        return self._bounds.clone()

    def integrate(self, frame: Any) -> None:
        """Take in a new frame, and train on it as long as the configuration says.

        Args:
            frame: an `isdf.DepthFrame`, or any object with its attributes.

        Raises:
            FrameError: the frame cannot be used; the map is as it was before the call.
        """
        frame = DepthFrame.of(frame).to(self.device)
        reach = self.config.sampling.max_depth
        if not bool(((frame.depth > 0) & (frame.depth <= reach)).any()):
            raise FrameError(
                f"no pixel of the frame is within sampling.max_depth = {reach} m; raise it, or skip this frame"
            )
        first = self._network is None
        self._judge_newest()
        if not first and self._newest is self.keyframes.frames[-1]:
            self._frozen = copy.deepcopy(self._network)  # with all that the keyframe taught it
        self._bounds = grown(self._bounds, frame, reach)
        if first:
            self._begin(frame)
        self._newest, self._newest_judged = frame, first
        self.frames_seen += 1
        steps = self.config.first_frame_steps if first else self.config.steps_per_frame
        for _ in range(steps):
            self.step()
        if steps > 0 and not first and self._judge_newest():
            for _ in range(self.config.keyframe_steps):
                self.step()

    def step(self) -> float:
        """One optimisation step on the newest frame, the last keyframe and replayed ones; returns the mean loss.

        Raises:
            DivergedError: the loss is NaN or infinite; the network is as it was before the call.
        """
        frames, keyframes = self._select()
        batch = sample_rays(frames, self.config.sampling, self.generator)
        bound, target = supervise(batch, self.config.bound)
        distance, gradient = self.network.distance_and_gradient(batch.points.reshape(-1, 3))
        distance, gradient = distance.view(bound.shape), gradient.view(target.shape)
        if self.config.losses.noise > 0:
            distance = distance + self._training_noise(distance)
        loss = total_loss(distance, gradient, bound, target, batch.behind, self.config.losses)
        mean = float(loss.detach().mean())
        if not math.isfinite(mean):
            raise DivergedError(
                f"the loss is {mean} at step {self.steps}: go on from an earlier checkpoint, with a lower "
                f"learning_rate than {self.config.learning_rate}"
            )
        assert self._optimiser is not None
        self._optimiser.zero_grad(set_to_none=True)
        loss.mean().backward()
        self._optimiser.step()
        self.steps += 1
        self._record(loss.detach().mean(dim=1), batch, keyframes, len(frames))
        return mean

    def run_for(self, cpu_seconds: float) -> int:
        """Train until this process has used `cpu_seconds` of CPU time in all its threads; returns the steps made.

        At least one step is made, so the budget can be exceeded by one step.
        """
        end = time.process_time() + cpu_seconds
        made = 0
        while made == 0 or time.process_time() < end:
            self.step()
            made += 1
        return made

    def field(self) -> NeuralField:
        """An immutable snapshot of the distance field."""
        return NeuralField(self.network, self.bounds)

    def cost_field(self, eps: float) -> CostField:
        """The CHOMP collision cost c(f(x)) with reach `eps` [m], over a snapshot of the field."""
        return CostField(self.field(), eps)

    def save(self, path: str | Path, note: Mapping[str, Any] | None = None) -> None:
        """Write everything needed to go on training to one file, atomically; `note` goes into its header."""
        from . import checkpoint

        checkpoint.save(self, Path(path), note or {})

    @classmethod
    def load(cls, path: str | Path, device: str | torch.device = "cpu") -> IsdfMapper:
        """Read a map written by `save`; training goes on exactly as it would have."""
        from . import checkpoint

        return checkpoint.load(Path(path), device)

    def _begin(self, frame: DepthFrame) -> None:
        origin = frame.T_world_camera[:3, 3]
        self._network = SDFNetwork(self.config.network, origin.cpu(), self.generator).to(self.device)
        self._frozen = copy.deepcopy(self._network)
        self._optimiser = new_optimiser(self._network, self.config)
        self.keyframes.add(frame)

    def _judge_newest(self) -> bool:
        """Make the newest frame a keyframe if it taught the frozen copy enough; True when it became one."""
        frame = self._newest
        if frame is None or self._newest_judged:
            return False
        assert self._frozen is not None
        self._newest_judged = True
        config = self.config.keyframes
        late = frame.time - self.keyframes.frames[-1].time > config.force_after
        if not late:
            share = explained_share(self._frozen, frame, config, self.config.sampling, self.generator)
            if share >= config.explained_below:
                return False
        self.keyframes.add(frame)
        return True

    def _select(self) -> tuple[list[DepthFrame], list[int]]:
        """The frames of this step: the newest, the last keyframe besides it, and replayed ones; and their indices.

        Indices are those of keyframes; the newest frame has one, the first, when it became a keyframe.
        """
        if self._newest is None:
            raise NotReadyError("there is nothing to train on: call mapper.integrate(frame) first")
        kept = self.keyframes.frames
        own = [len(kept) - 1] if self._newest is kept[-1] else []
        last = len(kept) - 1 - len(own)
        others = [last, *self.keyframes.draw(self.config.keyframes.replayed, last, self.generator)]
        others = others if last >= 0 else []
        return [self._newest, *(kept[i] for i in others)], own + others

    def _training_noise(self, distance: Tensor) -> Tensor:
        """Noise on the predicted distance [m], twice as strong in the further steps on a new keyframe."""
        further = len(self.keyframes) > 1 and self._newest is self.keyframes.frames[-1]
        scale = self.config.losses.noise * self.config.network.output_scale * (2 if further else 1)
        return scale * torch.randn(distance.shape, generator=self.generator).to(distance)

    def _record(self, ray_loss: Tensor, batch: RayBatch, keyframes: list[int], frames: int) -> None:
        """Update the running loss of the keyframes of this step: the last ones of its window."""
        total = torch.zeros(frames, device=ray_loss.device).index_add_(0, batch.frame, ray_loss)
        count = torch.bincount(batch.frame, minlength=frames).clamp(min=1)
        means = (total / count).tolist()
        for index, loss in zip(keyframes, means[frames - len(keyframes) :], strict=True):
            self.keyframes.record(index, loss)


def new_optimiser(network: SDFNetwork, config: IsdfConfig) -> torch.optim.AdamW:
    """AdamW with the configured rate and decay."""
    return torch.optim.AdamW(
        network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
    )
