"""Samples and bounds against known geometry: a plane, a ball, a furnished room."""

import math

import pytest
import torch

from isdf import DepthFrame, PinholeCamera, SamplingConfig
from isdf.bounds import BOUNDS, _nearest_by_product, batch_bound, nearest, normal_bound, ray_bound, supervise
from isdf.sampling import normals_at, sample_rays, valid_normals
from tests.isdf.rooms import ball, furnished_orbit, furnished_room, look_at, render

CAMERA = PinholeCamera.from_fov(80, 60, math.radians(60))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def wall(angle: float) -> tuple[DepthFrame, torch.Tensor]:
    """A plane 2 m ahead, turned about the vertical by `angle` [rad]; the frame and the plane's normal."""
    normal = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])
    sdf = lambda p: (p - torch.tensor([0.0, 0.0, 2.0]).to(p)) @ normal.to(p)  # noqa: E731
    return render(sdf, torch.eye(4).numpy(), CAMERA), normal


@pytest.mark.parametrize("method", list(BOUNDS))
def test_no_bound_is_ever_tighter_than_the_truth(method) -> None:
    sdf = furnished_room()
    batch = sample_rays(furnished_orbit(5), SamplingConfig(), generator())
    bound, _ = BOUNDS[method](batch)
    truth = sdf(batch.points)
    free = batch.behind > 0
    slack = 0.01 if method != "normal" else 0.35  # the normal bound assumes planes and may cheat near edges
    assert bool((bound[free] >= truth[free] - slack).all())


def test_bounds_are_ordered_by_tightness() -> None:
    batch = sample_rays(furnished_orbit(5), SamplingConfig(), generator())
    mean = {name: float(make(batch)[0].abs().mean()) for name, make in BOUNDS.items()}
    assert mean["batch"] < mean["normal"] < mean["ray"]


def test_batch_bound_is_at_least_as_tight_as_the_ray_bound() -> None:
    batch = sample_rays(furnished_orbit(5), SamplingConfig(), generator())
    assert bool((batch_bound(batch)[0].abs() <= ray_bound(batch)[0].abs() + 1e-4).all())


def test_normal_bound_is_exact_on_a_plane() -> None:
    frame, normal = wall(0.6)
    batch = sample_rays([frame], SamplingConfig(), generator())
    bound, gradient = normal_bound(batch)
    truth = (batch.points - torch.tensor([0.0, 0.0, 2.0])) @ normal
    close = (batch.behind.abs() < 0.3) & valid_normals(batch)[:, None]
    assert close.sum() > 1000
    torch.testing.assert_close(bound[close], truth[close], atol=2e-3, rtol=0)
    torch.testing.assert_close(gradient[close], normal.expand_as(gradient[close]), atol=1e-2, rtol=0)


def test_batch_bound_and_gradient_approach_the_truth_with_dense_surface_points() -> None:
    sdf = ball((0.0, 0.0, 2.0), 0.8)
    frame = render(lambda p: torch.minimum(sdf(p), 4 - p[..., 2]), torch.eye(4).numpy(), CAMERA)
    batch = sample_rays([frame], SamplingConfig(rays_per_frame=100, extra_surface=4000), generator())
    bound, gradient = supervise(batch, "batch")
    points = batch.points.reshape(-1, 3)
    near_ball = (
        (sdf(points) < 0.3)
        & (points[:, 2] < 1.6)
        & (points[:, :2].norm(dim=1) < 0.45)
        & (batch.behind.reshape(-1) > 0.05)
    )
    torch.testing.assert_close(bound.reshape(-1)[near_ball], sdf(points)[near_ball], atol=0.02, rtol=0)
    radial = torch.nn.functional.normalize(points - torch.tensor([0.0, 0.0, 2.0]), dim=-1)
    cosine = torch.nn.functional.cosine_similarity(gradient.reshape(-1, 3), radial)[near_ball]
    assert cosine.mean() > 0.98


def test_samples_behind_the_surface_get_negative_bounds() -> None:
    frame, _ = wall(0.0)
    batch = sample_rays([frame], SamplingConfig(), generator())
    behind = batch.points[..., 2] > 2.0 + 1e-4
    assert behind.any()
    for make in BOUNDS.values():
        bound, gradient = make(batch)
        assert bool((bound[behind] <= 0).all()) and bool((bound[batch.behind > 1e-4] >= 0).all())
        # The gradient of the distance points back to the camera on both sides of the wall.
        off = batch.behind.abs() > 0.02
        assert bool((gradient[off][:, 2] < 1e-3).all())


def test_surface_samples_get_zero_and_the_world_normal_whatever_way_the_camera_looks() -> None:
    sdf = lambda p: p[..., 2]  # noqa: E731  (a floor seen from above: its normal is world z, not camera z)
    frame = render(sdf, look_at((0.0, 0.0, 1.5), (1.0, 0.4, 0.0)), CAMERA)
    batch = sample_rays([frame], SamplingConfig(max_depth=5.0), generator())
    bound, target = supervise(batch, "batch")
    assert bool((bound[:, 0] == 0).all())
    usable = valid_normals(batch)
    assert usable.float().mean() > 0.8
    expected = torch.tensor([0.0, 0.0, 1.0]).expand(int(usable.sum()), 3)
    torch.testing.assert_close(target[usable, 0], expected, atol=0.02, rtol=0)


def test_normals_are_unknown_beside_holes_edges_and_the_border() -> None:
    depth = torch.full((60, 80), 2.0)
    depth[30, 40] = torch.nan
    depth[:, 60:] = 3.0
    frame = DepthFrame(depth, torch.eye(4), CAMERA)
    pixels = torch.tensor([[41, 30], [40, 31], [60, 10], [59, 10], [0, 5], [20, 0], [20, 20]])
    known = torch.isfinite(normals_at(frame, pixels, 1)).all(dim=-1)
    assert known.tolist() == [False] * 6 + [True]


def test_samples_lie_where_the_paper_puts_them() -> None:
    frame, _ = wall(0.0)
    config = SamplingConfig(rays_per_frame=300)
    batch = sample_rays([frame, frame], config, generator())
    assert batch.points.shape == (600, 29, 3)
    z = batch.points[..., 2]
    torch.testing.assert_close(z[:, 0], torch.full((600,), 2.0), atol=1e-5, rtol=0)
    gaussian, stratified = z[:, 1:9], z[:, 9:]
    low, middle, high = gaussian.reshape(-1).quantile(torch.tensor([0.16, 0.5, 0.84])) - 2.0
    assert abs(float(low) + 0.10) < 0.01 and abs(float(middle)) < 0.01 and abs(float(high) - 0.10) < 0.01
    assert float(gaussian.max()) == pytest.approx(2.10)  # what lies farther behind may be free again
    assert stratified.min() >= 0.07 and stratified.max() <= 2.10
    width = (2.10 - 0.07) / 20
    cells = ((stratified - 0.07) / width).floor().clamp(max=19)
    assert bool((cells == torch.arange(20)).all())
    assert batch.frame.tolist() == [0] * 300 + [1] * 300


def test_invalid_and_far_pixels_are_never_drawn() -> None:
    depth = torch.full((60, 80), torch.nan)
    depth[10, 10], depth[20, 20], depth[30, 30] = 1.0, 50.0, -1.0
    batch = sample_rays(
        [DepthFrame(depth, torch.eye(4), CAMERA)], SamplingConfig(rays_per_frame=20), generator()
    )
    assert torch.isfinite(batch.points).all()
    torch.testing.assert_close(batch.points[:, 0, 2], torch.ones(20))


@pytest.mark.parametrize("search", [nearest, _nearest_by_product])
def test_nearest_equals_brute_force_far_from_the_origin(search) -> None:
    offset = torch.tensor([300.0, -200.0, 50.0])
    points = torch.rand(400, 3, generator=generator(1)) * 4 + offset
    targets = torch.rand(300, 3, generator=generator(2)) * 4 + offset
    distance = torch.cdist(points.double(), targets.double())
    found = distance.gather(1, search(points, targets)[:, None])[:, 0]
    torch.testing.assert_close(found, distance.amin(dim=1), atol=1e-4, rtol=0)
