"""Maps for other programs: meshes, distance grids, point clouds and floor plans."""

from .formats import FORMATS, ExportConfig, export

__all__ = ["FORMATS", "ExportConfig", "export"]
