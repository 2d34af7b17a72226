"""Trajectories for robots covered by spheres, through any signed distance field.

The closed-loop base tracker and the refinement for wheels need casadi and are imported on their own: `from
planning.tracking import BaseTracker`, `from planning.refine import Refiner`.
"""

from planning.chomp import Chomp, ChompConfig
from planning.constraints import AxisConstraint, Constraint, GoalPose
from planning.descent import DescentConfig
from planning.ends import nearest_free
from planning.errors import ConfigError, FieldError, PlanningError, SolverError, TrajectoryError
from planning.initialise import NoPath, RrtConfig, rrt_connect
from planning.metric import MetricConfig
from planning.objective import ObjectiveConfig
from planning.plan import Planner, PlannerConfig
from planning.primitive_field import PrimitiveField, Solid
from planning.protocols import (
    CompilableField,
    CompilableRobot,
    ConfidentField,
    CostField,
    DistanceField,
    FloorRobot,
    LinkedRobot,
    SelfCollidingRobot,
    SphereRobot,
)
from planning.result import PlanResult, Status
from planning.timing import retime
from planning.trajectory import Trajectory
from planning.validation import Validation, ValidationConfig, check
from planning.workspace import WorkspaceConfig

__all__ = [
    "AxisConstraint",
    "Chomp",
    "ChompConfig",
    "CompilableField",
    "CompilableRobot",
    "ConfidentField",
    "ConfigError",
    "Constraint",
    "CostField",
    "DescentConfig",
    "DistanceField",
    "FieldError",
    "FloorRobot",
    "GoalPose",
    "LinkedRobot",
    "MetricConfig",
    "NoPath",
    "ObjectiveConfig",
    "PlanResult",
    "Planner",
    "PlannerConfig",
    "PlanningError",
    "PrimitiveField",
    "RrtConfig",
    "SelfCollidingRobot",
    "Solid",
    "SolverError",
    "SphereRobot",
    "Status",
    "Trajectory",
    "TrajectoryError",
    "Validation",
    "ValidationConfig",
    "WorkspaceConfig",
    "check",
    "nearest_free",
    "retime",
    "rrt_connect",
]
