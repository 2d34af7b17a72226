"""What a robot fills itself is free space, though its camera never sees it."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from .evidence import FREE
from .lattice import Lattice


def clear(
    lattice: Lattice, centres: Float[np.ndarray, "s 3"], radii: Float[np.ndarray, "s"]
) -> Float[np.ndarray, "2 3"] | None:
    """Mark the nodes inside some spheres as free.

    Args:
        lattice: its `evidence` is changed; what lies outside of it is left out.
        centres: [m].
        radii: [m].

    Returns:
        The box about the spheres [m], None where all of it was free already.
    """
    box = np.stack([(centres - radii[:, None]).min(axis=0), (centres + radii[:, None]).max(axis=0)])
    begin, end = lattice.window(box[0], box[1])
    evidence = lattice.read("evidence", begin, end)
    if not _mark(evidence, lattice.corner + begin, lattice.spacing, centres, radii):
        return None
    lattice.write(begin, end, evidence=evidence)
    return box


@njit(cache=True, nogil=True)
@no_type_check
def _mark(evidence, corner, spacing, centres, radii):
    """Make nodes inside spheres free; whether any was not."""
    changed = False
    for i in range(evidence.shape[0]):
        for j in range(evidence.shape[1]):
            for k in range(evidence.shape[2]):
                if evidence[i, j, k] == FREE:
                    continue
                for s in range(len(radii)):
                    x = spacing * (corner[0] + i) - centres[s, 0]
                    y = spacing * (corner[1] + j) - centres[s, 1]
                    z = spacing * (corner[2] + k) - centres[s, 2]
                    if x * x + y * y + z * z < radii[s] * radii[s]:
                        evidence[i, j, k] = FREE
                        changed = True
                        break
    return changed
