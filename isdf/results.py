"""What a mapping run leaves beside its map: a mesh, slices and a report."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from .atomic import replacing
from .commands import MAP_FILE, Outcome
from .datasets import DepthSequence
from .isdf_mapper import IsdfMapper
from .methods import OnlineMapper
from .runner import RunReport


def write_results(
    mapper: OnlineMapper, report: RunReport, sequence: DepthSequence, out: Path, settings: Any
) -> Outcome:
    """Write mesh.ply, slices.png and report.json.

    Args:
        mapper: of the run.
        report: of the run.
        sequence: what was mapped.
        out: the folder.
        settings: the `isdf map` command.
    """
    from .meshing import zero_level_mesh
    from .slices import estimate_up, save_slices, slice_heights

    field = mapper.field()
    poses = sequence.poses[np.isfinite(sequence.poses).all(axis=(1, 2))]
    up = estimate_up(poses) if settings.up is None else np.array(settings.up) / np.linalg.norm(settings.up)
    mesh = zero_level_mesh(field, settings.mesh_spacing, up=up)
    with replacing(out / "mesh.ply") as temporary:
        mesh.export(temporary, file_type="ply")
    heights = list(settings.slice_heights) or slice_heights(field, up)
    frames = mapper.keyframes.frames if isinstance(mapper, IsdfMapper) else []
    keyframes = np.array([f.T_world_camera[:3, 3].numpy() for f in frames]).reshape(-1, 3)
    with replacing(out / "slices.png") as temporary:
        save_slices(temporary, field, heights, up, poses, keyframes)
    summary = dataclasses.asdict(report) | {
        "sequence": settings.sequence_dir.name,
        "clock": {
            name: getattr(settings, name)
            for name in ("steps_per_frame", "steps_per_second", "cpu_per_second")
        },
        "method": settings.method,
        "preset": settings.preset,
        "config": dataclasses.asdict(mapper.config),
        "bounds": mapper.bounds.tolist(),
        "up": up.tolist(),
        "slice_heights": heights,
        "mesh_vertices": len(mesh.vertices),
        "mesh_faces": len(mesh.faces),
    }
    with replacing(out / "report.json") as temporary:
        temporary.write_text(json.dumps(summary, indent=1) + "\n")
    return Outcome(
        f"{report.frames_used} of {report.frames} frames, {report.keyframes} keyframes, {report.steps} steps in "
        f"{report.cpu_seconds:.1f} CPU s; {out}: {MAP_FILE}, mesh.ply ({len(mesh.faces)} faces), slices.png, "
        "report.json",
        summary | {"folder": str(out)},
    )
