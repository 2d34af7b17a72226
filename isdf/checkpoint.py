"""The state of `isdf.Mapper` as a map file: network, optimiser, random draws and keyframes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from .camera import PinholeCamera
from .errors import CheckpointError
from .frames import DepthFrame
from .keyframes import KeyframeConfig
from .losses import LossConfig
from .mapfile import consistent, read, require_finite, write
from .network import NetworkConfig, SDFNetwork
from .sampling import SamplingConfig

if TYPE_CHECKING:
    from .isdf_mapper import IsdfConfig, IsdfMapper

FORMAT = "isdf-map"
VERSION = 1


def save(mapper: IsdfMapper, path: Path, note: Mapping[str, Any]) -> None:
    """Write the whole state of a mapper; an existing file is replaced only by a complete new one.

    Args:
        mapper: what to save.
        path: the file.
        note: further entries of the header, such as where the frames came from.

    Raises:
        NotReadyError: no frame has been integrated yet.
        OSError: the folder cannot be written.
    """
    tensors, header = _state(mapper)
    write(path, tensors, {**note, **header})


def load(path: Path, device: str | torch.device = "cpu") -> IsdfMapper:
    """Read a map written by `save`.

    Raises:
        CheckpointError: the file is missing, damaged, inconsistent, of another kind or of a newer version.
    """
    tensors, header = read(path, FORMAT, VERSION)
    with consistent(path):
        return _restore(tensors, header, device)


def _state(mapper: IsdfMapper) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    tensors: dict[str, torch.Tensor] = {
        "bounds": mapper.bounds,
        "generator": mapper.generator.get_state(),
    }
    frozen, optimiser = mapper._frozen, mapper._optimiser
    assert frozen is not None and optimiser is not None
    for prefix, network in (("network", mapper.network), ("frozen", frozen)):
        tensors |= {f"{prefix}.{name}": value for name, value in network.state_dict().items()}
    for index, values in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{index}.{name}": value for name, value in values.items()}
    frames = list(mapper.keyframes.frames)
    newest = mapper._newest
    is_keyframe = any(frame is newest for frame in frames)
    if newest is not None and not is_keyframe:
        frames.append(newest)
    for index, frame in enumerate(frames):
        tensors[f"frame.{index}.depth"] = frame.depth
        tensors[f"frame.{index}.T_world_camera"] = frame.T_world_camera
    header = {
        "format": FORMAT,
        "version": VERSION,
        "config": dataclasses.asdict(mapper.config),
        "frames_seen": mapper.frames_seen,
        "steps": mapper.steps,
        "keyframe_losses": mapper.keyframes.losses,
        "frames": [{"camera": dataclasses.asdict(f.camera), "time": f.time} for f in frames],
        "newest": next(i for i, f in enumerate(frames) if f is newest),
        "newest_judged": mapper._newest_judged,
    }
    return tensors, header


def _restore(
    tensors: dict[str, torch.Tensor], header: dict[str, Any], device: str | torch.device
) -> IsdfMapper:
    from .isdf_mapper import IsdfMapper, new_optimiser

    config = _config(header["config"])
    _check_size(config.network, tensors)
    require_finite(tensors)
    mapper = IsdfMapper(config, device)
    mapper.frames_seen, mapper.steps = int(header["frames_seen"]), int(header["steps"])
    mapper.generator.set_state(tensors["generator"])
    mapper._bounds = tensors["bounds"].reshape(2, 3)
    mapper._network = _network(tensors, "network", mapper.config.network).to(mapper.device)
    mapper._frozen = _network(tensors, "frozen", mapper.config.network).to(mapper.device)
    mapper._optimiser = new_optimiser(mapper._network, mapper.config)
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimiser."):
            _, index, key = name.split(".")
            moments.setdefault(int(index), {})[key] = value
    _check_moments(moments, list(mapper._network.parameters()))
    groups = mapper._optimiser.state_dict()["param_groups"]
    mapper._optimiser.load_state_dict({"state": moments, "param_groups": groups})
    frames = [
        DepthFrame(
            tensors[f"frame.{i}.depth"],
            tensors[f"frame.{i}.T_world_camera"],
            PinholeCamera(**entry["camera"]),
            entry["time"],
        ).to(mapper.device)
        for i, entry in enumerate(header["frames"])
    ]
    losses = [float(loss) for loss in header["keyframe_losses"]]
    if not 1 <= len(losses) <= len(frames) or not all(math.isfinite(loss) and loss >= 0 for loss in losses):
        raise CheckpointError(f"it has {len(frames)} frames and the keyframe losses {losses}"[:200])
    mapper.keyframes.frames, mapper.keyframes.losses = frames[: len(losses)], losses
    newest = range(len(frames))[header["newest"]]
    mapper._newest = frames[newest]
    mapper._newest_judged = bool(header["newest_judged"]) or newest < len(losses)
    return mapper


def _check_size(config: NetworkConfig, tensors: dict[str, torch.Tensor]) -> None:
    """Refuse a configured network that is larger than the stored one, before memory is taken for it."""
    stored = sum(value.numel() for name, value in tensors.items() if name.startswith("network."))
    claimed = config.width * (config.width * (config.hidden_layers - 1) + config.frequency_octaves)
    if claimed > stored:
        raise CheckpointError(f"its network should have over {claimed:.3g} numbers and has {stored}")


def _check_moments(moments: dict[int, dict[str, torch.Tensor]], parameters: list[torch.nn.Parameter]) -> None:
    """Refuse optimiser state that does not fit the parameters, which would fail only at the next step."""
    for index, values in moments.items():
        shapes = {"exp_avg": parameters[index].shape, "exp_avg_sq": parameters[index].shape, "step": ()}
        for name, shape in shapes.items():
            if values[name].shape != shape or not values[name].is_floating_point():
                raise CheckpointError(
                    f"optimiser.{index}.{name} is {values[name].dtype} {tuple(values[name].shape)}"
                )


def _network(tensors: dict[str, torch.Tensor], prefix: str, config: NetworkConfig) -> SDFNetwork:
    network = SDFNetwork(config, torch.zeros(3))
    weights = {k[len(prefix) + 1 :]: v for k, v in tensors.items() if k.startswith(f"{prefix}.")}
    network.load_state_dict(weights)
    return network


def _config(values: dict[str, Any]) -> IsdfConfig:
    from .isdf_mapper import IsdfConfig

    return IsdfConfig(
        **values
        | {
            "network": NetworkConfig(**values["network"]),
            "sampling": SamplingConfig(**values["sampling"]),
            "losses": LossConfig(**values["losses"]),
            "keyframes": KeyframeConfig(**values["keyframes"]),
        }
    )
