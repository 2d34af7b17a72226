"""What all voxel maps share as online mappers: fuse each frame, rebuild the distances now and then."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .. import mapfile
from ..cost import CostField
from ..display import ShownMapper
from ..errors import CheckpointError, ConfigError, NotReadyError
from ..extent import grown, nothing_seen
from ..frames import DepthFrame
from .volume import GrowingVolume


class VoxelMapper(ShownMapper, abc.ABC):
    """Base of the voxel maps; the interface of `isdf.Mapper`, but with nothing to train.

    `integrate` fuses at once and rebuilds the distances when `rebuild_period` of frame time has passed since the
    last time; `field` gives the distances as they were last rebuilt, `refresh` brings them up to date before.

    Args:
        config: of the method; has `rebuild_period` [s] and `max_depth` [m].
        volume: empty.
    """

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int] = 1

    def __init__(self, config: Any, volume: GrowingVolume) -> None:
        self.config, self.volume = config, volume
        self.frames_seen = 0
        self.steps = 0
        self._bounds = nothing_seen()
        self._field: Any = None
        self._fresh = True
        self._rebuilt_at = -math.inf

    @abc.abstractmethod
    def _fuse(self, frame: DepthFrame) -> None:
        """Put one frame into the volume."""

    @abc.abstractmethod
    def _rebuild(self) -> Any:
        """A new field of the volume as it is, or None while it holds no surface."""

    def _check_channels(self) -> None:
        """Refuse channels, as read from a file, that do not belong together; methods that keep more than the channels
        make the rest anew.

        Raises:
            CheckpointError: says which.
        """
        shapes = {name: values.shape for name, values in self.volume.channels.items()}
        if len(set(shapes.values())) != 1 or any(len(shape) != 3 for shape in shapes.values()):
            raise CheckpointError(f"channels must be of one shape of 3 axes, got {shapes}")

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        """Lower and upper corner [m] of the surfaces and cameras seen so far; NotReadyError before the first."""
        if self.frames_seen == 0:
            raise NotReadyError("nothing was seen yet: call mapper.integrate(frame) first")
        return self._bounds.clone()

    @property
    def nbytes(self) -> int:
        """Memory of the volume and of the current field [bytes]."""
        return self.volume.nbytes + (0 if self._field is None else self._field.nbytes)

    def integrate(self, frame: Any) -> None:
        """Fuse a new frame; rebuild the distances when they are due.

        Args:
            frame: an `isdf.DepthFrame`, or any object with its attributes.

        Raises:
            FrameError: the frame cannot be used; the map is as it was before the call.
        """
        frame = DepthFrame.of(frame).to(torch.device("cpu"))
        self._fuse(frame)
        self._bounds = grown(self._bounds, frame, self.config.max_depth)
        self.frames_seen += 1
        self._fresh = False
        # A clock that stands still or jumps back must not stop the rebuilding.
        if not 0 < frame.time - self._rebuilt_at < self.config.rebuild_period or self._field is None:
            self.refresh()
            self._rebuilt_at = frame.time

    def refresh(self) -> None:
        """Rebuild the distances now, if a frame came in since the last time."""
        if not self._fresh:
            self._field = self._rebuild()
            self._fresh = True
            self.steps += 1

    def step(self) -> float:
        """Nothing: there is no training. It returns a loss of 0."""
        return 0.0

    def run_for(self, cpu_seconds: float) -> int:
        """Nothing: returns 0 steps at once, however long a time is given."""
        return 0

    def field(self) -> Any:
        """An immutable snapshot of the distance field, at most `rebuild_period` of frame time old.

        Raises:
            NotReadyError: no frame was integrated yet, or none showed a surface.
        """
        if self._field is None:
            raise NotReadyError("no surface was seen yet: call mapper.integrate(frame) first")
        return self._field

    def cost_field(self, eps: float) -> CostField:
        """The CHOMP collision cost c(f(x)) with reach `eps` [m], over a snapshot of the field."""
        return CostField(self.field(), eps)

    def save(self, path: str | Path, note: Mapping[str, Any] | None = None) -> None:
        """Write the volume to one file, atomically, after a `refresh`.

        Args:
            path: the file.
            note: further entries of the header, such as where the frames came from.

        Raises:
            NotReadyError: no frame has been integrated yet.
            OSError: the folder cannot be written.
        """
        tensors = {name: torch.from_numpy(values) for name, values in self.volume.channels.items()}
        tensors["bounds"] = self.bounds
        self.refresh()
        header = {
            "format": self.FORMAT,
            "version": self.VERSION,
            "config": dataclasses.asdict(self.config),
            "corner": self.volume.corner.tolist(),
            "frames_seen": self.frames_seen,
            "steps": self.steps,
            "rebuilt_at": None if math.isinf(self._rebuilt_at) else self._rebuilt_at,
        }
        mapfile.write(Path(path), tensors, {**(note or {}), **header})

    @classmethod
    def load(cls, path: str | Path) -> Any:
        """Read a map written by `save`; it answers as that one did and fusion can go on.

        Raises:
            CheckpointError: the file is missing, damaged, of another kind or of a newer version.
        """
        tensors, header = mapfile.read(Path(path), cls.FORMAT, cls.VERSION)
        with mapfile.consistent(Path(path)):
            return cls._restored(tensors, header)

    @classmethod
    def _restored(cls, tensors: dict[str, Tensor], header: dict[str, Any]) -> VoxelMapper:
        mapper = cls(cls.config_type()(**header["config"]))  # type: ignore[call-arg]
        volume = mapper.volume
        for name, empty in volume.channels.items():
            values = tensors[name].numpy()
            if values.dtype != empty.dtype:
                raise CheckpointError(f"channel {name} must be {empty.dtype}, got {values.dtype}")
            volume.channels[name] = values
        volume.corner = np.array(header["corner"], dtype=np.int64).reshape(3)
        mapper._check_channels()
        mapper._bounds = tensors["bounds"].reshape(2, 3)
        mapper.frames_seen, rebuilt = int(header["frames_seen"]), header["rebuilt_at"]
        mapper._fresh = False
        mapper.refresh()
        mapper.steps = int(header["steps"])
        mapper._rebuilt_at = -math.inf if rebuilt is None else float(rebuilt)
        return mapper

    @classmethod
    @abc.abstractmethod
    def config_type(cls) -> type:
        """The class of `config`."""


def check_period(period: float) -> None:
    """Refuse a negative or NaN rebuild period."""
    if not period >= 0:
        raise ConfigError(f"rebuild_period must be zero or more seconds, got {period}")
