"""A depth camera in the simulated world."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float32

from robots.errors import RobotError
from robots.simulation.poses import inverse_pose, link_frames
from robots.simulation.primitives import Primitive
from robots.simulation.ray_casting import RayCaster, joined, link_surfaces
from robots.simulation.world import World


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of an ideal camera: focal lengths and principal point [px], image size [px].

    Pixel (column u, row v) has its centre at the integer coordinates (u, v).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @staticmethod
    def from_fov(
        width: int = 160, height: int = 120, horizontal_fov: float = float(np.radians(58.0))
    ) -> PinholeCamera:
        """Square pixels and a centred principal point; the default is the view of an Xtion [rad]."""
        if not (0 < horizontal_fov < np.pi and width > 0 and height > 0):
            raise RobotError(
                f"need 0 < fov < pi and a positive size, got {horizontal_fov}, {width} x {height}"
            )
        f = width / 2 / float(np.tan(horizontal_fov / 2))
        return PinholeCamera(f, f, (width - 1) / 2, (height - 1) / 2, width, height)

    def rays(self) -> Float[np.ndarray, "height width 3"]:
        """Direction of every pixel in the camera frame, with z = 1: depth times it is the point seen."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack(((u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)), axis=-1)


@dataclass(frozen=True)
class DepthFrame:
    """One posed depth image.

    Attributes:
        depth: z-depth (height, width) [m], 0 where nothing was measured.
        T_world_camera: camera pose (4, 4), OpenCV axes: x right, y down, z forward.
        camera: the intrinsics.
        time: simulated time of capture [s].
    """

    depth: Float32[np.ndarray, "height width"]
    T_world_camera: Float[np.ndarray, "4 4"]
    camera: PinholeCamera
    time: float

    def points(self) -> Float[np.ndarray, "n 3"]:
        """Measured points [m, world]."""
        valid = self.depth > 0
        local = self.camera.rays()[valid] * self.depth[valid][:, None]
        return local @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]

    def sees(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Which places [m, world] it shows: in their direction, and in the pixels beside, nothing nearer was measured.

        What is as far as the measured surface is seen, too: within 3 cm, and more farther away as depth cameras go.
        """
        x, y, z = self.T_world_camera[:3, :3].T @ (points - self.T_world_camera[:3, 3]).T
        ahead, camera = np.maximum(z, 1e-3), self.camera
        u = np.round(x / ahead * camera.fx + camera.cx).clip(-9, camera.width + 9).astype(int)
        v = np.round(y / ahead * camera.fy + camera.cy).clip(-9, camera.height + 9).astype(int)
        inside = (z > 0) & (u > 0) & (u < camera.width - 1) & (v > 0) & (v < camera.height - 1)
        beside = np.arange(-1, 2)
        near = self.depth[v[inside, None, None] + beside[:, None], u[inside, None, None] + beside].min(
            axis=(1, 2)
        )
        inside[inside] = z[inside] <= near + 0.03 + 0.012 * near**2
        return inside


class DepthCamera:
    """Sees the scene, its moving objects and the robot itself; noise-free, see `DepthNoise`.

    Static solids form one mesh; every movable object and robot link is cast in its own frame and only
    where its bounding ball can appear in the image. The links fixed to the camera's link are its housing
    and stay invisible to it.

    Args:
        world: the world to look at.
        camera: intrinsics.
        link: robot link that carries the camera; None for a camera fixed in the world.
        T_link_camera: pose (4, 4) of the camera (OpenCV axes) in the link, or in the world without a link;
            identity if None, right for a URDF's optical frame.
        min_range: nearest depth measured [m].
        max_range: farthest depth measured [m].
        rate: frames per simulated second that `capture` gives.
        see_robot: whether the robot appears in the image.

    Raises:
        RobotError: if the ranges or the rate make no sense, or the robot has no such link.
    """

    def __init__(
        self,
        world: World,
        camera: PinholeCamera | None = None,
        *,
        link: str | None = None,
        T_link_camera: Float[np.ndarray, "4 4"] | None = None,
        min_range: float = 0.3,
        max_range: float = 5.0,
        rate: float = 30.0,
        see_robot: bool = True,
    ):
        if not (0 <= min_range < max_range and rate > 0):
            raise RobotError(
                f"need 0 <= min_range < max_range [m] and rate > 0 [Hz], got {min_range}, {max_range}, {rate}"
            )
        self.world = world
        self.camera = camera or PinholeCamera.from_fov()
        self.link = link
        self.T_link_camera = np.eye(4) if T_link_camera is None else np.array(T_link_camera, dtype=np.float64)
        self.min_range, self.max_range, self.rate = min_range, max_range, rate
        self._next_time = world.time
        self._rays = self.camera.rays()
        self._frustum = self._frustum_normals()
        self._joined: dict[str, Primitive] = {}
        self._joined_caster: RayCaster | None = None
        self._moved: set[str] = set()
        self._shapes: dict[tuple[str, tuple[float, float, float]], RayCaster] = {}
        self._links: dict[str, RayCaster] | None = None if see_robot else {}
        self._scene_surface = self._read_scene()
        self.pose()

    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Where the camera is now: T_world_camera, OpenCV axes."""
        T_world_link = np.eye(4) if self.link is None else self.world.robot.link_pose(self.link)
        return T_world_link @ self.T_link_camera

    def render(self) -> DepthFrame:
        """Take an image now, whatever the rate."""
        T_world_camera = self.pose()
        depth = np.full(self._rays.shape[:2], np.inf, dtype=np.float32)
        for caster, T_world_body in self._visible():
            self._draw(depth, caster, inverse_pose(T_world_body) @ T_world_camera)
        depth[(depth < self.min_range) | (depth > self.max_range)] = 0.0
        return DepthFrame(depth, T_world_camera, self.camera, self.world.time)

    def capture(self) -> DepthFrame | None:
        """Take an image if the next one is due at the camera's rate, else return None."""
        if self.world.time < self._next_time - 1e-9:
            return None
        # After a pause the rate starts anew: no burst of frames to catch up.
        due = self._next_time + 1 / self.rate
        self._next_time = due if due > self.world.time else self.world.time + 1 / self.rate
        return self.render()

    def _visible(self) -> Iterator[tuple[RayCaster, np.ndarray]]:
        """Every ray caster with the pose T_world_body of its frame."""
        solids = self.world.solids
        self._join_what_stays(solids)
        if self._joined_caster is not None:
            yield self._joined_caster, np.eye(4)
        for name, solid in solids.items():
            if name not in self._joined:
                shape = (solid.kind, solid.parameters)
                if shape not in self._shapes:
                    self._shapes[shape] = RayCaster(solid.local_mesh())
                yield self._shapes[shape], self.world.object_pose(name)
        if self.world.has_robot:
            if self._links is None:
                self._links = self._robot_casters()
            yield from zip(self._links.values(), self.world.robot.link_poses(list(self._links)), strict=True)

    def _join_what_stays(self, solids: dict[str, Primitive]) -> None:
        """Cast static solids together with the scene, but for those that were moved once: they may move again."""
        self._moved |= {name for name, solid in self._joined.items() if solids.get(name) is not solid}
        stay = {name: s for name, s in solids.items() if s.mass == 0 and name not in self._moved}
        if self._joined_caster is not None and stay.keys() == self._joined.keys():
            return
        meshes = [solid.mesh() for solid in stay.values()]
        if self._scene_surface is not None:
            meshes.append(self._scene_surface)
        self._joined, self._joined_caster = stay, RayCaster(joined(meshes)) if meshes else None

    def _robot_casters(self) -> dict[str, RayCaster]:
        """One for each link with a surface, but for the camera's own housing, which it looks out of."""
        robot = self.world.robot
        housing = set() if self.link is None else robot.rigid_group(self.link)
        surfaces = link_surfaces(self.world.client, robot.body)
        named = ((robot.link_names[surface.link], surface.mesh) for surface in surfaces)
        return {name: RayCaster(mesh) for name, mesh in named if name not in housing}

    def _draw(self, depth: np.ndarray, caster: RayCaster, T_body_camera: np.ndarray) -> None:
        """Cast the pixels where the body can be and keep the nearer hits; a ray's parameter is its depth."""
        centre = inverse_pose(T_body_camera)[:3] @ [*caster.centre, 1.0]
        window = self._window(centre, caster.radius)
        if window is None:
            return
        rays = self._rays[window]
        directions = rays.reshape(-1, 3) @ T_body_camera[:3, :3].T
        hits = caster.cast(T_body_camera[:3, 3], directions).reshape(rays.shape[:2])
        np.minimum(depth[window], hits, out=depth[window])

    def _frustum_normals(self) -> np.ndarray:
        """Inward unit normals (5, 3) of the planes through the image's edges and of the image plane."""
        a, b, c, d = (self._rays[row, column] for row, column in ((0, 0), (0, -1), (-1, -1), (-1, 0)))
        normals = np.stack((np.cross(b, a), np.cross(c, b), np.cross(d, c), np.cross(a, d), [0.0, 0.0, 1.0]))
        normals *= np.sign(normals[:, 2:])
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def _window(self, centre: np.ndarray, radius: float) -> tuple[slice, slice] | None:
        """Rows and columns that can show a ball at `centre` in the camera frame; None if none can."""
        x, y, z = centre.tolist()
        if z - radius > self.max_range or (self._frustum @ centre < -radius).any():
            return None
        c = self.camera
        if z <= 1.05 * radius:
            return slice(0, c.height), slice(0, c.width)
        # A ball lies within a cone; along one axis its tangents are at atan(x / z) -+ asin(r / hypot(x, z)).
        spans = []
        for along, focal, principal, size in ((y, c.fy, c.cy, c.height), (x, c.fx, c.cx, c.width)):
            middle, half = np.arctan2(along, z), np.arcsin(radius / np.hypot(along, z))
            low, high = principal + focal * np.tan([middle - half, middle + half])
            first, last = max(0, int(np.floor(low))), min(size, int(np.ceil(high)) + 1)
            if first >= last:
                return None
            spans.append(slice(first, last))
        return spans[0], spans[1]

    def _read_scene(self) -> trimesh.Trimesh | None:
        """Surface of the scene's URDF in the world frame, if it has one."""
        body = self.world.scene_body
        if body is None:
            return None
        client = self.world.client
        surfaces = link_surfaces(client, body)
        frames = link_frames(client, body, [surface.link for surface in surfaces])
        parts = [s.mesh.apply_transform(frame) for s, frame in zip(surfaces, frames, strict=True)]
        return joined(parts) if parts else None
