"""Metrics are zero for the truth, exact for known errors, and judge every point; unseen points really are unseen."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from isdf import DepthFrame, PinholeCamera
from isdf.datasets import SequenceWriter, open_sequence
from isdf.errors import EvaluationError
from isdf.evaluation import (
    BINS,
    SeenSurface,
    Truth,
    VisibleRegion,
    draw_rays,
    evaluate,
    evaluate_rays,
    first_zero,
    hold_out,
    observed_voxels,
    roc_area,
    unseen_points,
)
from tests.isdf.rooms import SDF, ball, box, furnished_room, inside_of, look_at, render, union


class Analytic:
    """Any function of points as a distance field, with gradients by autograd."""

    def __init__(self, sdf: SDF) -> None:
        self.distance = sdf

    def distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        points = points.detach().requires_grad_(True)
        with torch.enable_grad():
            distance = self.distance(points)
            (gradient,) = torch.autograd.grad(distance.sum(), points)
        return distance.detach(), gradient


ROOM = furnished_room()
BOX = torch.tensor([[-2.5, -2.0, 0.0], [2.5, 2.0, 2.5]])


@pytest.fixture(scope="module")
def truth() -> Truth:
    points = (
        torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * (BOX[1] - BOX[0] + 0.2)
        + BOX[0]
        - 0.1
    )
    return Truth.of(Analytic(ROOM), points)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Six views of one corner of the furnished room; the other end stays unseen."""
    camera = PinholeCamera.from_fov(64, 48, math.radians(60))
    writer = SequenceWriter(tmp_path_factory.mktemp("corner") / "sequence", camera, fps=5.0)
    for i in range(6):
        frame = render(ROOM, look_at((-0.5 + 0.05 * i, -0.3, 1.2), (2.0, 0.2 * i, 0.6)), camera)
        writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    return open_sequence(writer.folder)


@pytest.mark.parametrize("gradient", ["central", "own"])
def test_the_truth_scores_zero(truth, gradient) -> None:
    scores = evaluate(Analytic(ROOM), truth, gradient)
    assert scores.sdf_error == scores.cost_error == scores.overestimated == 0
    # Central differences straddle the creases of the field, which gradients do not.
    assert scores.gradient_distance < (1e-6 if gradient == "central" else 0.01)


@pytest.mark.parametrize("offset", [-0.2, 0.03, 0.08])
def test_an_offset_field_scores_the_offset(truth, offset) -> None:
    scores = evaluate(Analytic(lambda p: ROOM(p) + offset), truth)
    assert scores.sdf_error == pytest.approx(abs(offset), abs=1e-5)
    assert scores.bias == pytest.approx(offset, abs=1e-5)
    assert scores.overestimated == (1.0 if offset > 0.05 else 0.0)
    assert scores.gradient_distance < 1e-4
    # Inside solids and down to 2 m outside the cost falls no faster than the distance grows.
    assert 0 < scores.cost_error <= abs(offset) + 1e-6


def test_the_negated_field_has_opposite_gradients_and_a_constant_none(truth) -> None:
    assert evaluate(Analytic(lambda p: -ROOM(p)), truth).gradient_distance == pytest.approx(2, abs=1e-4)
    assert evaluate(Analytic(lambda p: 0 * p[..., 0]), truth).gradient_distance == pytest.approx(1)


def test_bins_partition_the_points_and_their_errors(truth) -> None:
    noise = torch.randn(len(truth), generator=torch.Generator().manual_seed(1)) * 0.1
    field = Analytic(lambda p: ROOM(p) + (noise if len(p) == len(noise) else 0))
    scores = evaluate(field, truth, "own")
    assert len(scores.bins) == len(BINS) - 1
    assert sum(b.points for b in scores.bins) == scores.points == len(truth)
    assert sum(b.points * (b.sdf_error or 0) for b in scores.bins) == pytest.approx(
        len(truth) * scores.sdf_error
    )
    for low, high, found in zip(BINS, BINS[1:], scores.bins, strict=False):
        inside = (truth.distance >= low) & (truth.distance < high)
        assert found.points == int(inside.sum())


def test_an_empty_region_has_no_scores_instead_of_perfect_ones(truth) -> None:
    scores = evaluate(Analytic(ROOM), truth.where(torch.zeros(len(truth), dtype=torch.bool)))
    assert scores.points == 0 and scores.sdf_error is None


def test_unmapped_points_cost_as_much_as_a_surface(truth) -> None:
    field, unmapped = Analytic(ROOM), truth.distance > 0.5
    scores = evaluate(field, truth, unmapped=unmapped)
    assert scores.sdf_error == 0
    far = truth.distance[unmapped].double()
    expected = (1.0 - (far - 2).clamp(max=0) ** 2 / 4).sum() / len(truth)
    assert scores.cost_error == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("gradient", ["central", "own"])
def test_answers_that_are_no_numbers_are_refused(truth, bad, gradient) -> None:
    def holed(p: Tensor) -> Tensor:
        return torch.where(p[..., 0] > 2.4, bad, ROOM(p))

    with pytest.raises(EvaluationError, match="NaN or infinite at"):
        evaluate(Analytic(holed), truth, gradient)


def test_a_truth_with_nan_is_refused(truth) -> None:
    with pytest.raises(EvaluationError, match="distance"):
        dataclasses.replace(
            truth, distance=truth.distance.clone().index_fill_(0, torch.tensor([3]), math.nan)
        )


def test_roc_area_rewards_doubt_where_errors_are() -> None:
    error = torch.rand(500, generator=torch.Generator().manual_seed(0)) * 0.1
    assert roc_area(1 - error, error) == 1.0
    assert roc_area(error, error) == 0.0
    assert roc_area(torch.ones(500), error) == pytest.approx(0.5)
    noisy = torch.rand(500, generator=torch.Generator().manual_seed(1))
    assert roc_area(noisy, error) == pytest.approx(0.5, abs=0.1)
    wrong, right = error > 0.05, error <= 0.05
    pairs = (noisy[wrong][:, None] < noisy[right]).float().mean()
    assert roc_area(noisy, error) == pytest.approx(float(pairs))
    assert roc_area(noisy, 0 * error) is None
    with pytest.raises(EvaluationError, match="NaN"):
        roc_area(noisy * math.nan, error)


def test_visible_points_lie_in_front_of_what_was_measured(sequence) -> None:
    points = VisibleRegion(sequence).points(last=5, count=3001, seed=0)
    assert len(points) == 3001
    distance = ROOM(points)
    # At most 10 cm of z-depth behind a surface, so less than 15 cm along the ray.
    assert -0.15 < float(distance.min()) < 0
    assert 0.01 < float((distance < 0).float().mean()) < 0.2
    again = VisibleRegion(sequence).points(last=5, count=3001, seed=0)
    assert torch.equal(points, again)
    assert not torch.equal(points, VisibleRegion(sequence).points(last=5, count=3001, seed=1))


def test_visible_points_are_of_frames_so_far(sequence) -> None:
    first = VisibleRegion(sequence, stride=1).points(last=0, count=500, seed=0)
    eye = torch.tensor([-0.5, -0.3, 1.2])
    inverse = torch.linalg.inv(sequence[0].T_world_camera)[:3].float()
    seen = (first - eye) @ inverse[:, :3].T
    assert bool((seen[:, 0].abs() / seen[:, 2] < math.tan(math.radians(31))).all())


def test_unseen_points_are_free_in_the_room_and_far_from_every_ray(sequence) -> None:
    points = unseen_points(sequence, Analytic(ROOM), BOX, 800, seed=0)
    assert len(points) == 800
    assert float(ROOM(points).min()) > 0
    assert bool(((points >= BOX[0]) & (points <= BOX[1])).all())
    along = torch.linspace(0, 1, 60)[:, None, None]
    for i in (0, 5):
        frame = sequence[i]
        eye, surface = frame.T_world_camera[:3, 3].float(), frame.thinned(2, 12.0)
        rays = (eye + along * (surface - eye)).reshape(-1, 3)
        gap = min(float(torch.cdist(points, block).min()) for block in rays.split(4000))
        assert gap > 0.25


def test_a_room_seen_from_the_middle_all_round_has_no_unseen_points_in_the_open(tmp_path) -> None:
    sdf, camera = inside_of(box((0, 0, 1), (2, 2, 2))), PinholeCamera.from_fov(40, 40, math.radians(100))
    writer = SequenceWriter(tmp_path / "s", camera)
    for target in ((1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, -1, 1), (0.001, 0, 2), (0.001, 0, 0)):
        frame = render(sdf, look_at((0, 0, 1), target), camera)
        for _ in range(5):
            writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    room, seen = torch.tensor([[-1.0, -1, 0], [1, 1, 2]]), open_sequence(tmp_path / "s")
    assert float(observed_voxels(seen, room, 0.1).float().mean()) > 0.95
    assert len(unseen_points(seen, Analytic(sdf), room, 100, seed=0)) == 0


def test_the_seen_surface_is_exact_where_it_was_seen_and_never_too_near(sequence, truth) -> None:
    seen = SeenSurface(sequence, Analytic(ROOM), stride=1)
    inside = truth.distance < 0
    assert bool((seen.distance(truth.points)[inside] < 0).all()) and bool(inside.any())
    assert bool((seen.distance(truth.points).abs() > truth.distance.abs() - 1e-3).all())
    for i in (0, 5):
        frame = sequence[i]
        eye, surface = frame.T_world_camera[:3, 3].float(), frame.thinned(1, 12.0)
        before = surface + 0.05 * (eye - surface) / (eye - surface).norm(dim=1, keepdim=True)
        error = seen.distance(before) - ROOM(before)
        assert float(error.max()) < 0.04 and float(error.mean()) < 0.006
    hidden = unseen_points(sequence, Analytic(ROOM), BOX, 200, seed=0)
    assert float((seen.distance(hidden) - ROOM(hidden)).mean()) > 0.3


def test_a_surface_that_no_frame_shows_is_refused(sequence) -> None:
    with pytest.raises(EvaluationError, match=r"no frame shows a surface within 0\.2 m"):
        SeenSurface(sequence, Analytic(ROOM), max_depth=0.2)


def test_held_out_frames_are_not_mapped_and_the_clock_is_kept(sequence) -> None:
    mapped, held = hold_out(sequence, every=3)
    assert sorted([*mapped.indices, *held.indices]) == list(range(len(sequence)))
    assert held.indices == [1, 4]
    assert len(mapped) / mapped.fps == pytest.approx(len(sequence) / sequence.fps)
    assert torch.equal(held[1].depth, sequence[4].depth) and np.array_equal(held.poses[1], sequence.poses[4])
    with pytest.raises(EvaluationError, match="2 to 6"):
        hold_out(sequence, every=7)


def test_the_first_zero_is_interpolated_and_only_within_the_limit() -> None:
    z = torch.tensor([[0.0, 1, 2, 3]])
    hit, found = first_zero(z, torch.tensor([[1.0, 0.5, -0.5, 2]]), torch.tensor([3.0]))
    assert float(hit) == pytest.approx(1.5) and bool(found)
    hit, found = first_zero(z, torch.tensor([[1.0, 1, 1, -1]]), torch.tensor([2.5]))
    assert float(hit) == 2.5 and not bool(found)
    hit, found = first_zero(z, torch.tensor([[-1.0, 1, 1, 1]]), torch.tensor([2.5]))
    assert float(hit) == 0 and bool(found)


def test_rays_find_the_truth_right_and_wrong_fields_wrong(sequence) -> None:
    rays = draw_rays(sequence, 600, seed=0)
    right = evaluate_rays(Analytic(ROOM), rays)
    # Table edges and legs end between samples; everything else is exact to the image's 0.2 mm.
    assert right.median_error < 2e-3 and right.within > 0.97 and right.missed < 0.02
    assert right.blocked < 0.002 and right.overestimated == 0
    thick = evaluate_rays(Analytic(lambda p: ROOM(p) - 0.1), rays)
    assert thick.within < 0.02 and thick.median_error > 0.1 and thick.blocked > 0.01
    far = evaluate_rays(Analytic(lambda p: 0 * p[..., 0] + 9), rays)
    assert far.missed == 1 and far.mean_error == pytest.approx(1.0) and far.overestimated > 0.9
    extra = evaluate_rays(Analytic(union(ROOM, ball((0.4, 0.0, 1.0), 0.2))), rays)
    assert extra.blocked > right.blocked and extra.mean_error > right.mean_error
    with pytest.raises(EvaluationError, match="NaN"):
        evaluate_rays(Analytic(lambda p: ROOM(p) * math.nan), rays)


def test_rays_need_measurements_in_reach(tmp_path) -> None:
    camera = PinholeCamera.from_fov(8, 6, 1.0)
    writer = SequenceWriter(tmp_path / "s", camera)
    frame = DepthFrame(np.full((6, 8), 6.0), np.eye(4), camera)
    writer.write(frame.depth.numpy(), frame.T_world_camera.numpy())
    with pytest.raises(EvaluationError, match="no frame has a pixel"):
        draw_rays(open_sequence(tmp_path / "s"), 10, seed=0)
