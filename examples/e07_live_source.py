"""7. Map from a live camera: anything that `for frame in source` works with.

    python -m examples.e07_live_source --out runs/e07

The camera is that of a simulated robot which turns on the spot; its poses are the robot's kinematics, as on a real one.
A RealSense or a ROS 2 topic takes its place without another change:

    source = isdf.sources.RealSenseSource(pose=lambda time: T_world_camera)       # poses from a function
    source = isdf.sources.Ros2Source("/camera/depth/image_raw", world_frame="odom")   # poses from tf

Leaves map.safetensors and slice.png.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tqdm import tqdm

if not __package__:  # run as a file
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import isdf
from examples.episode import Episode, EpisodeOptions
from isdf.sources import LiveSource


class SimulatedCamera(LiveSource):
    """The head camera of a robot that turns on the spot in a furnished room.

    Args:
        episode: the robot in its world.
        fps: images a second of its time.
        turn: how fast it turns [rad/s].
    """

    def __init__(self, episode: Episode, fps: float, turn: float) -> None:
        super().__init__("simulated camera")
        self._robot, self._period, self._turn = episode.robot, 1 / fps, turn
        self.camera = isdf.PinholeCamera(**vars(episode.robot.camera.camera))

    def _next(self) -> isdf.DepthFrame | None:
        self._robot.drive(0.0, self._turn, self._period)
        seen = self._robot.observe()  # without the robot's own body
        return self._frame(seen.depth, seen.T_world_camera, seen.time)


@dataclass(frozen=True)
class LiveMap(EpisodeOptions):
    """Map a room from the camera of a robot that turns once on the spot."""

    fps: float = 5.0
    """Images a second of the robot's time."""
    seconds: float = 12.6
    """How long the robot turns, in its time [s]."""


def frames(source: LiveSource, seconds: float) -> Iterator[isdf.DepthFrame]:
    """What a source gives within a time [s] of its own, with a progress bar."""
    first = None
    for frame in tqdm(source, desc="mapping", unit=" frames", disable=None):
        first = frame.time if first is None else first
        if frame.time - first > seconds:
            return
        yield frame


def main(options: LiveMap) -> isdf.Snapshot:
    """Map, save, draw; returns the last snapshot."""
    torch.set_num_threads(1)
    episode = Episode(options)
    options.out.mkdir(parents=True, exist_ok=True)
    source = SimulatedCamera(episode, options.fps, turn=0.5)
    with source, isdf.BackgroundMapper(isdf.Mapper(), queue_size=8) as background:
        for frame in frames(source, options.seconds):
            background.integrate(frame)
        background.flush()
        print(background, source, sep="\n")
        background.save(options.out / "map.safetensors")
    snapshot = background.snapshot()  # still answers when the mapper is closed
    error = (snapshot.field.distance(way := probes(snapshot)) - episode.world.field().distance(way)).abs()
    print(f"off by {100 * error.median():.1f} cm in the median where a robot could be")
    snapshot.field.plot_slice(0.5).savefig(options.out / "slice.png")
    episode.close()
    return snapshot


def probes(snapshot: isdf.Snapshot) -> torch.Tensor:
    """Random points (n, 3) [m] that the map is sure of."""
    low, high = snapshot.bounds
    points = low + (high - low) * torch.rand(20_000, 3)
    return points[(snapshot.field.confidence(points) > 0.5) & (points[:, 2] > 0.05)]


if __name__ == "__main__":
    chosen = tyro.cli(LiveMap, description=__doc__)
    main(chosen)
    print(f"map and picture: {chosen.out}")
