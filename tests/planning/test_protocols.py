import subprocess
import sys

from planning import (
    ConfidentField,
    CostField,
    DistanceField,
    FloorRobot,
    LinkedRobot,
    SelfCollidingRobot,
    SphereRobot,
)
from tests.planning.fields import Confident, HingeCost, Sphere
from tests.planning.robots import Base, Disc, PlanarArm

BALL = Sphere((0.0, 0.0, 0.0), 1.0)


def test_what_is_offered_is_told_by_isinstance():
    assert isinstance(BALL, DistanceField) and not isinstance(BALL, CostField | ConfidentField)
    assert isinstance(HingeCost(BALL, 0.1), CostField) and not isinstance(HingeCost(BALL, 0.1), DistanceField)
    assert isinstance(Confident(BALL, 0.0), ConfidentField)
    assert isinstance(Disc(), SphereRobot) and not isinstance(
        Disc(), FloorRobot | LinkedRobot | SelfCollidingRobot
    )
    assert isinstance(Base(), FloorRobot) and isinstance(Base(), LinkedRobot)
    assert isinstance(PlanarArm(), SelfCollidingRobot)


def test_planning_needs_no_solver_until_a_base_is_tracked():
    code = "import sys, planning; sys.exit('casadi' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
