"""How good a map is: the paper's metrics at points of known distance, and rays of frames that were held out."""

from .metrics import BINS, Scores, evaluate, roc_area
from .points import VisibleRegion, observed_voxels, unseen_points
from .rays import Rays, RayScores, draw_rays, evaluate_rays, first_zero
from .seen_surface import SeenSurface
from .split import Part, hold_out
from .truth import GRADIENT_STEP, Truth, central_differences

__all__ = [
    "BINS",
    "GRADIENT_STEP",
    "Part",
    "RayScores",
    "Rays",
    "Scores",
    "SeenSurface",
    "Truth",
    "VisibleRegion",
    "central_differences",
    "draw_rays",
    "evaluate",
    "evaluate_rays",
    "first_zero",
    "hold_out",
    "observed_voxels",
    "roc_area",
    "unseen_points",
]
