"""What a prompt and a notebook show of fields and maps, and pictures made without pyplot."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from PIL import Image

import isdf
from isdf import ConfigError, GridField
from isdf.voxel import ExactConfig, ExactMapper
from tests.isdf.rooms import furnished_orbit


def ball() -> GridField:
    """A ball of 0.5 m about (0, 0, 0.5) in a box of 2 x 3 x 2 m."""
    x, y, z = torch.meshgrid(torch.arange(21), torch.arange(31), torch.arange(21), indexing="ij")
    places = torch.stack([x, y, z], dim=-1) * 0.1 + torch.tensor([-1.0, -1.5, -0.5])
    return GridField((places - torch.tensor([0.0, 0, 0.5])).norm(dim=-1) - 0.5, places[0, 0, 0], 0.1)


def coloured(png: bytes, channel: int) -> int:
    """How many pixels are mostly red (0) or blue (2)."""
    with Image.open(io.BytesIO(png)) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    others = np.delete(pixels, channel, axis=-1).max(axis=-1)
    return int((pixels[..., channel] > others + 40).sum())


def test_a_field_tells_its_size_and_shows_its_middle() -> None:
    field = ball()
    assert repr(field) == "<GridField over 2.0 x 3.0 x 2.0 m>"
    drawn = [field.plot_slice(*height).axes[0].images[0].get_array() for height in ((), (1.3,))]
    inside = (drawn[0] < 0).sum() * (3.0 / 250) ** 2  # [m^2]
    assert inside == pytest.approx(np.pi * 0.5**2, abs=0.03) and drawn[1].min() > 0.2
    assert coloured(field._repr_png_(), 0) > 300 and coloured(field._repr_png_(), 2) > 1000
    axes = field.plot_slice().axes[0]
    assert axes.get_title() == "height 0.50 m"
    assert np.ptp(axes.images[0].get_extent()[:2]) < np.ptp(axes.images[0].get_extent()[2:])


def test_colours_fit_the_size_of_what_is_drawn() -> None:
    """In a room they end where planners stop caring; a thing on a table of 40 cm would be pale then."""
    limits = []
    for half in (0.2, 0.5, 10.0):
        region = torch.tensor([[-half, -half, 0.0], [half, half, 1.0]])
        low, high = (
            isdf.plot_slice(ball(), 0.5, bounds=region, spacing=half / 20).axes[0].images[0].get_clim()
        )
        assert low == -high
        limits.append(high)
    assert limits[0] < 0.2 and limits[0] < limits[1] < limits[2] == 1.5


def test_up_bounds_and_path_are_followed() -> None:
    poses = np.stack([frame.T_world_camera.numpy() for frame in furnished_orbit(12)])
    region = torch.tensor([[-0.5, -0.5, 0.0], [0.5, 0.5, 2.0]])
    figure = isdf.plot_slice(ball(), 0.2, up=(0.0, 3.0, 0.0), poses=poses, bounds=region, spacing=0.1)
    axes = figure.axes[0]
    assert axes.get_title() == "height 0.20 m" and len(axes.lines) == 1
    left, right, low, high = axes.images[0].get_extent()
    assert sorted([right - left, high - low]) == pytest.approx([1.4, 2.4])  # across x and z
    with pytest.raises(ConfigError, match="up must be a direction"):
        isdf.plot_slice(ball(), up=(0.0, 0.0, 0.0))


def test_a_mapper_tells_how_far_it_is_and_shows_its_field() -> None:
    mapper = ExactMapper(ExactConfig(voxel=0.15, truncation=0.4))
    assert repr(mapper) == "<ExactMapper: no frame yet>" and mapper._repr_png_() is None
    for frame in furnished_orbit(12)[:6]:
        mapper.integrate(frame)
    mapper.refresh()
    assert repr(mapper).startswith("<ExactMapper: 6 frames, ") and repr(mapper).endswith(" m seen>")
    assert coloured(mapper._repr_png_(), 2) > 500 and "Field over" in repr(mapper.field())
    neural = isdf.IsdfMapper(isdf.IsdfConfig(first_frame_steps=2))
    neural.integrate(furnished_orbit(12)[0])
    assert "IsdfMapper: 1 frames, 2 steps" in repr(neural) and "NeuralField over" in repr(neural.field())
    with isdf.BackgroundMapper(neural) as background:
        assert "of IsdfMapper, running: 0 frames used" in repr(background)
    assert "closed" in repr(background)
