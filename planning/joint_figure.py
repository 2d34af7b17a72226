"""Picture of a trajectory: every joint over time."""

from __future__ import annotations

import io
from collections.abc import Sequence

from matplotlib.figure import Figure

from planning.trajectory import Trajectory


class JointFigure(Figure):
    """A figure that notebooks show inline, whether or not pyplot was imported."""

    def _repr_png_(self) -> bytes:
        data = io.BytesIO()
        self.savefig(data, format="png", dpi=90)
        return data.getvalue()


def joint_figure(trajectory: Trajectory, names: Sequence[str] = ()) -> JointFigure:
    """Curves of all joints [rad | m] over time [s], labelled with `names`, or with their numbers."""
    figure = JointFigure(figsize=(7, 3.5), layout="constrained")
    axes = figure.subplots()
    labels = names or [f"joint {i}" for i in range(trajectory.num_dofs)]
    times, values = trajectory.times.cpu().numpy(), trajectory.waypoints.cpu().numpy()
    for i, (column, label) in enumerate(zip(values.T, labels, strict=True)):
        # matplotlib has ten colours.
        axes.plot(times, column, "-" if i < 10 else "--", label=label)
    axes.set(xlabel="time [s]", ylabel="joint [rad | m]")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=8, frameon=False)
    return figure
