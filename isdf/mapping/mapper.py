"""The default map: distances between what the views prove, guessed by a network where they leave a gap."""

from __future__ import annotations

import functools
import logging
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import PinholeCamera
from ..cost import CostField
from ..display import ShownMapper
from ..errors import FrameError, NotReadyError
from ..extent import grown, nothing_seen
from ..frames import DepthFrame
from .agreement import compare
from .bricks import BrickVolume, missing_bricks, view_box
from .completion import load_network
from .config import MapperConfig
from .distortion import Distortion
from .evidence import look_through
from .field import LatticeField
from .footprint import clear
from .fusion import fuse, nearest_around
from .lately import Lately
from .lattice import Lattice
from .motion import Moment, Motion
from .refresh import guess, middle_of_guesses, refresh
from .standing import extend_down, vertical
from .visitors import Visitors

logger = logging.getLogger(__name__)

# Voxels between the nodes of the coarse lattice.
RATIO = 8
# The map reaches this far beyond what was seen, across and along the vertical [m].
BEYOND_ACROSS, BEYOND_ALONG = 2.5, 1.5
# Distances are written anew this far outside what a frame looked at [m].
MARGIN = 0.8
# A frame is passed over when more than this share of its points contradicts the map, of those that can be judged by it,
# which must be this share of all, unless its pose is confirmed by the motion: then somebody stands before the camera.
# And no more than so many frames in a row: then the world has changed, not the frame.
CONTRADICTED, JUDGED, PATIENCE = 0.35, 0.25, 5
# Columns of an image that are compared with the map.
COLUMNS = 80


class Mapper(ShownMapper):
    """Maps posed depth images online: fuse each, write distances down now and then, guess between bounds.

    `integrate` fuses at once and refreshes the distances when `refresh_period` of frame time has passed; `step` and
    `run_for` refresh whatever came in since. Frames that contradict the map or repeat the last image are passed over
    with a line in the log.

    Args:
        config: see `MapperConfig`.
        device: where the network runs; everything else runs on the CPU.
    """

    def __init__(self, config: MapperConfig | None = None, device: str | torch.device = "cpu") -> None:
        compile_kernels()
        self._begin(config or MapperConfig(), torch.device(device))

    def _begin(self, config: MapperConfig, device: torch.device) -> None:
        self.config, self.device = config, device
        self.bricks = BrickVolume(self.config.voxel, self.config.max_bricks)
        self.lattice = Lattice(RATIO * self.config.voxel)
        self.visitors = Visitors(self.bricks, self.lattice, self.config.truncation, self.config.visitors)
        self.distortion = Distortion(self.config.distortion)
        self.network = load_network().to(self.device)
        self.frames_seen = self.frames_skipped = self.steps = 0
        self.up = np.zeros(3)
        self._bounds = nothing_seen()
        self._viewed: np.ndarray | None = None
        self._fused_at = self._refreshed_at = self._guessed_at = -math.inf
        self._ready = False
        self._last: np.ndarray | None = None
        self._frozen, self._refused, self._motion = False, 0, Motion()

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        """Lower and upper corner [m] of the surfaces and cameras seen so far; NotReadyError before the first."""
        if self.frames_seen == 0:
            raise NotReadyError("nothing was seen yet: call mapper.integrate(frame) first")
        return self._bounds.clone()

    @property
    def nbytes(self) -> int:
        """Memory of all that mapping goes on from, without the network [bytes]."""
        return self.bricks.nbytes + self.lattice.nbytes

    def integrate(self, frame: Any) -> None:
        """Fuse a new frame, and refresh the distances when they are due.

        Args:
            frame: an `isdf.DepthFrame`, or any object with its attributes.

        Raises:
            FrameError: the frame cannot be used; the map is as it was before the call.
        """
        frame = DepthFrame.of(frame).to(torch.device("cpu"))
        measured, T = self._usable(frame), frame.T_world_camera.numpy()
        if self._repeats(measured, frame.time):
            return
        if 0 < frame.time - self._fused_at < self.config.fuse_period:
            self.frames_seen += 1
            self._keep_up(T[:3, 3], frame.time)
            return
        depth = self.distortion.correct(measured, _intrinsics(frame))
        stride = max(1, depth.shape[1] // COLUMNS)
        appeared = self._appeared(depth, T, stride, frame)
        if appeared is None:
            self._keep_up(T[:3, 3], frame.time)
            return
        box = view_box(depth, *self._band, _intrinsics(frame), T)
        self.bricks.include(box[0], box[1])
        bounds, up = grown(self._bounds, frame, self.config.max_depth), self.up - T[:3, 1]
        axis, way = vertical(up)
        beyond = np.full(3, BEYOND_ACROSS)
        beyond[axis] = BEYOND_ALONG
        seen = bounds.numpy().astype(float)
        self.lattice.include(np.minimum(seen[0] - beyond, box[0]), np.maximum(seen[1] + beyond, box[1]))
        self._bounds, self.up = bounds, up
        floor = float(seen[0 if way > 0 else 1, axis])
        self.visitors.watch(depth, appeared, stride, _intrinsics(frame), T, up, floor, frame.time)
        self._fuse(depth, T, frame, box, appeared, stride)
        since, self._fused_at = frame.time - self._fused_at, frame.time
        self._motion.believe(Moment(depth, _intrinsics(frame), T, frame.time))
        self.distortion.learn(measured, _intrinsics(frame), T)
        self.frames_seen += 1
        feet = self.visitors.stand(depth, _intrinsics(frame), np.linalg.inv(T), up)
        for part in (box, feet):
            if part is not None:
                self._touch(part + np.array([[-MARGIN], [MARGIN]]))
        if self._guess_due(frame.time, since):
            self._guess(T[:3, 3])
            self._guessed_at = frame.time
        self._keep_up(T[:3, 3], frame.time)

    def clear_footprint(self, centres: Float[np.ndarray, "s 3"], radii: Float[np.ndarray, "s"]) -> None:
        """Take note that space inside some spheres [m] is free: where the robot is that carries the camera.

        Its camera does not see there, and without this the map might guess that something stands in it.

        Raises:
            FrameError: a centre is not finite, a radius not finite and positive, or there are not as many of both; the
                map has not changed.
        """
        good = np.isfinite(centres).all() and np.isfinite(radii).all() and (radii > 0).all()
        if centres.shape != (len(radii), 3) or not good:
            raise FrameError(
                "clear_footprint needs finite centres (s, 3) and positive radii (s,), got shapes "
                f"{centres.shape} and {radii.shape}, radii from {radii.min(initial=np.inf):g} m"
            )
        if self.frames_seen and len(radii):
            box = clear(self.lattice, centres.astype(float), radii.astype(float))
            if box is not None:
                self._touch(box + np.array([[-MARGIN], [MARGIN]]))

    def refresh(self) -> None:
        """Bring the distances up to date with all frames so far."""
        if self._viewed is not None and refresh(self.lattice, self.bricks, self._viewed):
            self._viewed, self._ready = None, True
            self.steps += 1

    def step(self) -> float:
        """The same as `refresh`; there is no loss to return, so it is 0."""
        self.refresh()
        return 0.0

    def run_for(self, cpu_seconds: float) -> int:
        """Refresh if a frame came in since the last time; returns how often: 0 or 1, for there is no more to gain."""
        before = self.steps
        end = time.process_time() + cpu_seconds
        while self._viewed is not None and self.steps == before and time.process_time() < end:
            self.refresh()
        return self.steps - before

    def field(self) -> LatticeField:
        """An immutable snapshot of the distance field, at most `refresh_period` of frame time old.

        Raises:
            NotReadyError: no frame was integrated yet, or none showed a surface.
        """
        if not self._ready:
            raise NotReadyError("no surface was seen yet: call mapper.integrate(frame) first")
        lattice, nodes = self.lattice, self.lattice.nodes.arrays
        snapshot = LatticeField(
            lattice.table.copy(),
            nodes["value"],
            nodes["confidence"],
            nodes["block"],
            lattice.corrections,
            nodes["evidence"],
            lattice.corner.copy(),
            lattice.spacing,
            self._bounds,
            self.visitors.lately(),
        )
        lattice.readers.add(snapshot)
        return snapshot

    def cost_field(self, eps: float) -> CostField:
        """The CHOMP collision cost c(f(x)) with reach `eps` [m], over a snapshot of the field."""
        return CostField(self.field(), eps)

    def save(self, path: str | Path, note: Mapping[str, Any] | None = None) -> None:
        """Write everything to go on from to one file, atomically, after a `refresh`; `note` goes into its header."""
        from . import state

        state.save(self, Path(path), note or {})

    @classmethod
    def load(cls, path: str | Path, device: str | torch.device = "cpu") -> Mapper:
        """Read a map written by `save`."""
        from . import state

        return state.load(Path(path), device)

    def _usable(self, frame: DepthFrame) -> Float[np.ndarray, "h w"]:
        depth = frame.depth.numpy()
        depth = np.where(depth <= self.config.max_depth, depth, np.float32(0))
        if not depth.any():
            raise FrameError(
                f"no pixel of the frame is within max_depth = {self.config.max_depth} m; raise it, or skip this frame"
            )
        return depth

    def _repeats(self, depth: Float[np.ndarray, "h w"], when: float) -> bool:
        """Whether the image is the last one again: a camera that hangs, whatever its pose says."""
        same = self._last is not None and np.array_equal(depth, self._last)
        self._last = depth
        if same and not self._frozen:
            logger.warning(
                "at %.2f s the depth image repeats the last one: the camera hangs; passed over", when
            )
        elif self._frozen and not same:
            logger.warning("at %.2f s the camera is back", when)
        self._frozen = same
        self.frames_skipped += same
        return same

    def _appeared(
        self, depth: Float[np.ndarray, "h w"], T: Float[np.ndarray, "4 4"], stride: int, frame: DepthFrame
    ) -> np.ndarray | None:
        """Where something stands in space known to be free; None if the frame is to be passed over."""
        if not self._ready:
            return np.zeros((-(-depth.shape[0] // stride), -(-depth.shape[1] // stride)), dtype=bool)
        appeared, contradicted, judged = compare(
            self.lattice.arrays, self.bricks.arrays, depth, stride, _intrinsics(frame), T
        )
        moment = Moment(depth, _intrinsics(frame), T, frame.time)
        verdict = self._motion.judge(moment, stride)
        complaint = ""
        if judged > JUDGED and contradicted > CONTRADICTED and not verdict.confirmed:
            complaint = f"{100 * contradicted:.0f} % of the depth image contradict the map"
        elif verdict.away is not None:
            complaint = f"the depth image fits the last one {100 * verdict.away:.0f} cm from its pose"
        if not complaint:
            self._refused = 0
            return appeared
        if self._refused >= PATIENCE:  # and on, until a frame agrees again
            return appeared
        self._refused += 1
        self.frames_skipped += 1
        logger.warning("at %.2f s %s: a jump of the pose? passed over", frame.time, complaint)
        return None

    @property
    def _band(self) -> tuple[float, float]:
        """Truncation per squared depth, and the least of it [m]."""
        return self.config.truncation_noise, self.config.truncation

    def _fuse(
        self,
        depth: Float[np.ndarray, "h w"],
        T: Float[np.ndarray, "4 4"],
        frame: DepthFrame,
        box: np.ndarray,
        appeared: np.ndarray,
        stride: int,
    ) -> None:
        config, bricks, lattice, intrinsics = self.config, self.bricks, self.lattice, _intrinsics(frame)
        band = self._band
        # At the far end of the range neighbouring rays are still closer than half a brick.
        sparse = max(1, int(4 * bricks.voxel * frame.camera.fx / config.max_depth))
        bricks.add(missing_bricks(bricks.arrays, depth, sparse, *band, intrinsics, T))
        inverse = np.linalg.inv(T)
        around = nearest_around(depth, frame.camera.fx)
        fuse(bricks.arrays, *bricks.box(*box), depth, around, *band, config.max_weight, intrinsics, inverse)
        begin, end = lattice.window(*box)
        evidence = lattice.read("evidence", begin, end)
        first, size = lattice.corner + begin, end - begin
        look_through(
            evidence, first, lattice.spacing, 0 * size, size, depth, appeared, stride, intrinsics, inverse
        )  # fmt: skip
        lattice.write(begin, end, evidence=evidence)

    def _guess(self, eye: Float[np.ndarray, "3"]) -> None:
        middle = middle_of_guesses(eye, self.up, self._bounds.numpy().astype(float), self.lattice.spacing)
        box = guess(self.lattice, self.bricks, self.network, middle, self.up)
        if box is not None:
            self._touch(box)

    def _guess_due(self, now: float, since: float) -> bool:
        """Whether to guess with a frame that comes so long after the last one [s].

        Soon after a refresh, where frames come often enough: if it were shortly before one, those that have waited for
        that would wait for the network, too.
        """
        if not self._ready:
            return True
        soon, period = self.config.refresh_period / 2, self.config.guess_period
        if since < soon and not 0 <= now - self._refreshed_at < soon:
            period += min(period, self.config.refresh_period)
        return not 0 < now - self._guessed_at < period

    def _refresh_due(self, now: float) -> bool:
        # A clock that stands still or jumps back must not stop the refreshing.
        return not self._ready or not 0 < now - self._refreshed_at < self.config.refresh_period

    def _keep_up(self, eye: Float[np.ndarray, "3"], now: float) -> None:
        """Refresh when it is due, whether the newest frame was believed or not."""
        if self._refresh_due(now):
            left = self.visitors.take_back(eye, now)
            if left is not None:
                refresh(self.lattice, self.bricks, left + np.array([[-MARGIN], [MARGIN]]))
            self.refresh()
            self._refreshed_at = now

    def _touch(self, box: np.ndarray) -> None:
        """Have a box (2, 3) [m] refreshed with the next refresh."""
        old = box if self._viewed is None else self._viewed
        self._viewed = np.stack([np.minimum(old[0], box[0]), np.maximum(old[1], box[1])])


@functools.cache
def compile_kernels() -> None:
    """Compile everything that runs later, so that no frame waits for it."""
    camera = PinholeCamera(12.0, 12.0, 7.5, 5.5, 16, 12)
    mapper = object.__new__(Mapper)
    mapper._begin(MapperConfig(visitors=1.0), torch.device("cpu"))
    for index in range(2):
        depth = torch.full((12, 16), 1.0 + 0.01 * index)
        depth[4:8, 4:8] -= 0.3
        frame = DepthFrame(depth, torch.eye(4), camera, time=float(2 * index))
        mapper.integrate(frame)
    anywhere, T = np.ones((12, 16), dtype=bool), frame.T_world_camera.numpy()
    intrinsics, none = _intrinsics(frame), np.empty((0, 5), dtype=np.int64)
    mapper.clear_footprint(np.zeros((1, 3)), np.ones(1))
    mapper.visitors.watch(depth.numpy(), anywhere, 1, intrinsics, T, mapper.up, 1.0, frame.time)
    extend_down(
        mapper.bricks.arrays, none, 1, *vertical(mapper.up), depth.numpy(), intrinsics, np.linalg.inv(T)
    )
    mapper.distortion.relative(*depth.shape)
    field = mapper.field()
    for dtype in (torch.float32, torch.float64):
        field.distance_and_gradient(torch.zeros(1, 3, dtype=dtype))
        field.confidence(torch.zeros(1, 3, dtype=dtype))
        field.observed(torch.zeros(1, 3, dtype=dtype))
        Lately.of(np.zeros((1, 3), dtype=np.int64), 1.0).near(np.zeros((1, 3), np.dtype(str(dtype)[6:])))


def _intrinsics(frame: DepthFrame) -> tuple[float, float, float, float]:
    camera = frame.camera
    return float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)
