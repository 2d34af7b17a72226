"""Maps as files: safetensors for the numbers, a JSON header for the rest, one atomic write, no pickle."""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes

from .camera import PinholeCamera
from .errors import CheckpointError, IsdfError
from .frames import DepthFrame
from .keyframes import KeyframeConfig
from .losses import LossConfig
from .network import NetworkConfig, SDFNetwork
from .sampling import SamplingConfig

if TYPE_CHECKING:
    from .isdf_mapper import IsdfConfig, IsdfMapper

FORMAT = "isdf-map"
VERSION = 1


def save(mapper: IsdfMapper, path: Path) -> None:
    """Write the whole state of a mapper; an existing file is replaced only by a complete new one.

    Raises:
        NotReadyError: no frame has been integrated yet.
        OSError: the folder cannot be written.
    """
    write(path, *_state(mapper))


def load(path: Path, device: str | torch.device = "cpu") -> IsdfMapper:
    """Read a map written by `save`.

    Raises:
        CheckpointError: the file is missing, damaged, of another kind or of a newer version.
    """
    tensors, header = read(path, FORMAT, VERSION)
    try:
        return _restore(tensors, header, device)
    except (KeyError, TypeError, IndexError, RuntimeError, AttributeError, IsdfError) as error:
        raise CheckpointError(
            f"{path}: the map is incomplete or inconsistent ({error}); map again"
        ) from error


def write(path: Path, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None:
    """Write tensors and a JSON header to one file; an existing file is replaced only by a complete new one."""
    data = to_bytes(tensors, metadata={"isdf": json.dumps(header)})
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def kind(path: Path) -> str:
    """The `format` that the header of a map file names.

    Raises:
        CheckpointError: the file is missing, damaged or no map.
    """
    if not path.is_file():
        raise CheckpointError(
            f"{path}: no such file; a map is written by mapper.save(path) or `isdf map --out`"
        )
    try:
        with safe_open(str(path), framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("isdf", "null"))
    except (SafetensorError, json.JSONDecodeError, OSError) as error:
        raise CheckpointError(f"{path}: not a readable map ({error})") from error
    if not isinstance(header, dict) or not isinstance(header.get("format"), str):
        raise CheckpointError(f"{path}: a safetensors file, but not a map written by this package")
    return header["format"]


def read(path: Path, expected: str, version: int) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and header of a map file of the expected format and version.

    Raises:
        CheckpointError: the file is missing, damaged, of another kind or of another version.
    """
    found = kind(path)
    if found != expected:
        raise CheckpointError(
            f"{path}: a map of format {found!r}, not {expected!r}; isdf.load_map(path) reads every kind"
        )
    with safe_open(str(path), framework="pt") as file:
        header = json.loads(file.metadata()["isdf"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if header.get("version") != version:
        raise CheckpointError(
            f"{path}: map format version {header.get('version')}, this release reads {version}; "
            "update the package or map again"
        )
    return tensors, header


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
        "units": "metres",
        "frame": "world",
        "config": dataclasses.asdict(mapper.config),
        "frames_seen": mapper.frames_seen,
        "steps": mapper.steps,
        "keyframe_losses": mapper.keyframes.losses,
        "frames": [{"camera": dataclasses.asdict(f.camera), "time": f.time} for f in frames],
        "newest": next(i for i, f in enumerate(frames) if f is newest),
        "newest_judged": mapper._newest_judged,
    }
    return {name: value.detach().cpu().contiguous() for name, value in tensors.items()}, header


def _restore(
    tensors: dict[str, torch.Tensor], header: dict[str, Any], device: str | torch.device
) -> IsdfMapper:
    from .isdf_mapper import IsdfMapper, new_optimiser

    mapper = IsdfMapper(_config(header["config"]), device)
    mapper.frames_seen, mapper.steps = int(header["frames_seen"]), int(header["steps"])
    mapper.generator.set_state(tensors["generator"])
    mapper._bounds = tensors["bounds"]
    mapper._network = _network(tensors, "network", mapper.config.network).to(mapper.device)
    mapper._frozen = _network(tensors, "frozen", mapper.config.network).to(mapper.device)
    mapper._optimiser = new_optimiser(mapper._network, mapper.config)
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimiser."):
            _, index, key = name.split(".")
            moments.setdefault(int(index), {})[key] = value
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
    mapper.keyframes.frames, mapper.keyframes.losses = frames[: len(losses)], losses
    mapper._newest = frames[header["newest"]]
    mapper._newest_judged = bool(header["newest_judged"])
    return mapper


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
