"""The paper's mapping experiments as lists of independent jobs: which method maps which sequence in which time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

from isdf import IsdfConfig, MapperConfig
from isdf.bounds import BoundMethod
from isdf.datasets import DepthSequence
from isdf.methods import Config, OnlineMapper
from isdf.runner import RunReport, Watch, run_at_rate, run_at_steps
from isdf.voxel import ExactConfig, FiestaConfig, KinectFusionConfig, VoxbloxConfig

Experiment = Literal["main", "half", "bounds", "fidelity", "fidelity-bounds", "real"]
REAL: Experiment = "real"
# The method whose mapped region the paper evaluates separately.
REGION_OF = "voxblox"


@dataclass(frozen=True)
class Clock:
    """What time a method has: `amount` CPU seconds, or optimisation steps, for each second of sequence."""

    unit: Literal["cpu", "steps"] = "cpu"
    amount: float = 1.0

    def run(self, sequence: DepthSequence, config: Config, watch: Watch) -> tuple[OnlineMapper, RunReport]:
        """Map the sequence by this clock."""
        if self.unit == "steps":
            assert isinstance(config, IsdfConfig)
            return run_at_steps(sequence, config, self.amount, watch)
        return run_at_rate(sequence, config, self.amount, watch)


# As on the paper's machine, whatever this one makes.
PAPER_CLOCK = Clock("steps", 30.0)


@dataclass(frozen=True)
class Job:
    """One run of one method on one sequence.

    Args:
        experiment: the folder its result goes to.
        sequence: name of the sequence's folder.
        method: label in tables and figures.
        config: of the method.
        clock: the time it has.
        seed: of a method that draws; the voxel maps do not.
        noise_free: map the noise-free depth.
    """

    experiment: str
    sequence: str
    method: str
    config: Config
    clock: Clock = Clock()
    seed: int = 0
    noise_free: bool = False

    @property
    def key(self) -> str:
        """Name of the result's file, without an ending."""
        return f"{self.experiment}/{self.sequence}__{self.method.replace(' ', '_')}__{self.seed}"


METHODS: dict[str, Config] = {
    "default": MapperConfig(),
    "isdf": IsdfConfig(),
    "voxblox": VoxbloxConfig(),
    "fiesta": FiestaConfig(),
    "kinectfusion": KinectFusionConfig(),
    "exact": ExactConfig(),
}
# At half the budget the paper's rivals must do with larger voxels to stay real-time; the others keep theirs.
HALF_BUDGET: dict[str, Config] = METHODS | {
    "voxblox": VoxbloxConfig(voxel=0.078),
    "fiesta": FiestaConfig(voxel=0.078),
    "kinectfusion": KinectFusionConfig(voxel=0.08),
}


def main_comparison(sequences: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """Every method with one CPU second for each second of sequence (paper, section 6)."""
    return _methods("main", METHODS, Clock("cpu", 1.0), sequences, seeds)


def half_budget(sequences: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """Every method with half the time (paper, section 6 and appendix)."""
    return _methods("half", HALF_BUDGET, Clock("cpu", 0.5), sequences, seeds)


def bounds_ablation(sequences: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """The three supervision bounds with the small network, 30 steps for each second of sequence."""
    return _bounds("bounds", IsdfConfig(), get_args(BoundMethod), sequences, seeds)


def fidelity(sequences: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """The released settings in full, batch bound, 30 steps a second: about two CPU seconds a step."""
    return _bounds("fidelity", IsdfConfig.released(), ("batch",), sequences, seeds)


def fidelity_bounds(sequences: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """The released settings in full with the other two bounds."""
    return _bounds("fidelity", IsdfConfig.released(), ("normal", "ray"), sequences, seeds)


def real_sequences(sequences: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """Every method live on real sequences, to be judged by frames it was not given."""
    return _methods(REAL, METHODS, Clock("cpu", 1.0), sequences, seeds)


EXPERIMENTS: dict[Experiment, Callable[[Sequence[str], Sequence[int]], list[Job]]] = {
    "main": main_comparison,
    "half": half_budget,
    "bounds": bounds_ablation,
    "fidelity": fidelity,
    "fidelity-bounds": fidelity_bounds,
    "real": real_sequences,
}


def _methods(
    experiment: str, methods: dict[str, Config], clock: Clock, sequences: Sequence[str], seeds: Sequence[int]
) -> list[Job]:
    return [
        Job(experiment, sequence, method, _seeded(config, seed), clock, seed)
        for sequence in sequences
        for method, config in methods.items()
        for seed in (seeds if isinstance(config, IsdfConfig) else (0,))
    ]


def _bounds(
    experiment: str,
    config: IsdfConfig,
    bounds: Sequence[BoundMethod],
    sequences: Sequence[str],
    seeds: Sequence[int],
) -> list[Job]:
    return [
        Job(experiment, name, f"isdf {bound}", replace(config, bound=bound, seed=seed), PAPER_CLOCK, seed)
        for name in sequences
        for seed in seeds
        for bound in bounds
    ]


def _seeded(config: Config, seed: int) -> Config:
    return replace(config, seed=seed) if isinstance(config, IsdfConfig) else config
