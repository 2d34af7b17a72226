from __future__ import annotations

import numpy as np
import pybullet
import pytest
import torch

from robots.errors import RobotError, SceneError, UnknownJointError, UnknownLinkError
from robots.simulation import Box, Scene, Sphere, World
from robots.simulation.poses import planar_pose
from robots.simulation.rooms import can, small_box
from tests.robots.simulation.models import CART_JOINTS, PANDA_JOINTS, PANDA_URDF, Hand

HEAD = ("pan_joint", "tilt_joint")


@pytest.fixture
def cart(yard, cart_urdf):
    with World(yard) as world:
        world.add_robot(cart_urdf, CART_JOINTS, [0.0, 0.0, 0.0, 0.3], head_joints=HEAD)
        yield world


def test_base_drives_straight_at_the_commanded_speed(cart):
    cart.robot.reset([-3.0, 0.0, 0.6, 0.3])
    cart.command_base(0.5, 0.0)
    cart.step(1.0)
    start, _ = cart.robot_state()
    cart.step(2.0)
    q, qdot = cart.robot_state()
    assert q[:2] - start[:2] == pytest.approx(np.array([np.cos(0.6), np.sin(0.6)]), rel=0.02)
    assert q[2] == pytest.approx(0.6, abs=1e-3)
    assert np.hypot(*qdot[:2]) == pytest.approx(0.5, rel=0.02)
    assert cart.contacts() == [], "the hovering base must not touch the floor"


def test_base_drives_a_circle(cart):
    cart.robot.reset([-2.0, 0.0, 0.0, 0.3])
    cart.command_base(0.4, 0.8)
    cart.step(1.0)
    q0, _ = cart.robot_state()
    centre = q0[:2] + 0.5 * np.array([-np.sin(q0[2]), np.cos(q0[2])])
    for _ in range(8):
        cart.step(0.5)
        q, _ = cart.robot_state()
        assert np.linalg.norm(q[:2] - centre) == pytest.approx(0.5, rel=0.02)
    assert q[2] - q0[2] == pytest.approx(0.8 * 4, rel=0.02)


def test_base_stops_at_a_wall_and_the_contact_is_reported(cart):
    cart.robot.reset([1.0, 0.0, np.pi, 0.3])
    cart.command_base(-0.5, 0.0)
    cart.step(4.0)
    q, qdot = cart.robot_state()
    # The wall's face is at x = 2 and the chassis has a radius of 0.25 m.
    assert q[0] == pytest.approx(1.75, abs=0.01) and abs(qdot[0]) < 0.01
    contacts = {c.link: c for c in cart.contacts()}
    assert set(contacts) == {"chassis"} and contacts["chassis"].body == "wall"
    assert 0 < contacts["chassis"].depth < 0.01 and 0 < contacts["chassis"].force < 700
    assert contacts["chassis"].position[0] == pytest.approx(2.0, abs=0.02)
    assert cart.contacts(ignore=["wall"]) == []


def test_a_short_touch_between_two_calls_is_not_missed(cart):
    # Dropped onto the arm's edge, the ball bounces off and falls to the floor within one call of step.
    cart.robot.reset([0.0, 0.0, 0.0, 0.0])
    cart.add_body(Sphere("ball", planar_pose(0.4, 0.045, 0.95), 0.05, mass=0.05))
    cart.step(2.0)
    assert [(c.link, c.body) for c in cart.contacts()] == [("arm", "ball")]
    assert cart.object_pose("ball")[2, 3] < 0.1
    cart.step(0.5)
    assert cart.contacts() == [], "contacts are those of the last call only"


def test_arm_holds_against_gravity_and_reaches_its_target_within_its_speed(cart):
    q, _ = cart.robot_state()
    cart.step(1.0)
    assert cart.robot_state()[0] == pytest.approx(q, abs=1e-3)
    target = q.copy()
    target[3] = -0.7
    cart.command_joints(target)
    cart.step(0.1)
    assert abs(cart.robot_state()[1][3]) <= 1.5 + 1e-2
    cart.step(1.5)
    assert cart.robot_state()[0][3] == pytest.approx(-0.7, abs=1e-3)


def test_velocity_commands_move_the_arm_and_leave_the_base(cart):
    q, _ = cart.robot_state()
    cart.command_joint_velocities([9.0, 9.0, 9.0, -0.5])
    cart.step(1.0)
    after, qdot = cart.robot_state()
    assert after[3] - q[3] == pytest.approx(-0.5, rel=0.02) and qdot[3] == pytest.approx(-0.5, rel=0.02)
    assert after[:3] == pytest.approx(q[:3], abs=0.01)


def test_head_turns_and_carries_its_camera_link(cart):
    cart.command_head(0.5, 0.4)
    cart.step(1.0)
    pose = cart.robot.link_pose("optical")
    down = np.sin(0.4)
    forward = [np.cos(0.4) * np.cos(0.5), np.cos(0.4) * np.sin(0.5), -down]
    assert pose[:3, 2] == pytest.approx(np.array(forward), abs=5e-3)
    assert pose[:3, 3] == pytest.approx(np.array([0, 0, 1.2]), abs=5e-3)
    assert cart.robot.rigid_group("optical") == {"tilt", "optical"}


def test_objects_come_go_and_move_while_running(cart):
    cart.add_body(Box("crate", planar_pose(-1, 1, 0.5), (0.2, 0.2, 0.2), mass=1.0))
    cart.step(1.0)
    assert cart.object_pose("crate")[2, 3] == pytest.approx(0.1, abs=2e-3), "it fell to the floor"
    cart.set_object_pose("wall", planar_pose(3, 0, 1))
    assert cart.object_pose("wall")[0, 3] == pytest.approx(3.0)
    cart.command_base(0.5, 0.0)
    cart.step(5.0)
    assert cart.robot_state()[0][0] > 2.0, "the wall is no longer in the way"
    cart.remove_body("crate")
    with pytest.raises(SceneError, match=r"no solid named 'crate'.*floor"):
        cart.object_pose("crate")


def test_ground_truth_follows_the_objects(cart):
    cart.add_body(Sphere("ball", planar_pose(-1, 1, 2.0), 0.1, mass=1.0))
    point = torch.tensor([-1.0, 1.0, 2.0])
    assert float(cart.field().distance(point)) == pytest.approx(-0.1)
    cart.step(2.0)
    assert float(cart.field().distance(point)) == pytest.approx(1.8, abs=5e-3)


def test_worlds_do_not_share_anything(yard, cart_urdf):
    with World(yard) as one, World(yard) as two:
        one.add_robot(cart_urdf, CART_JOINTS, [0.0, 0.0, 0.0, 0.3])
        one.remove_body("wall")
        one.step(0.1)
        assert "wall" in two.solids and two.time == 0.0 and not two.has_robot
    one.close()


def test_same_commands_give_the_same_motion(yard, cart_urdf):
    ends = []
    for _ in range(2):
        with World(yard) as world:
            world.add_robot(cart_urdf, CART_JOINTS, [0.0, 0.0, 0.0, 0.3])
            world.command_base(0.6, 0.3)
            world.step(4.0)
            ends.append(world.robot_state()[0])
    assert np.array_equal(*ends)


def test_errors_name_what_is_wrong(yard, cart_urdf):
    with World(yard) as world:
        with pytest.raises(RobotError, match="no robot yet"):
            world.robot_state()
        with pytest.raises(RobotError, match="no URDF at"):
            world.add_robot("nowhere.urdf", (), [])
        with pytest.raises(UnknownJointError, match=r"'elbow'.*'shoulder'"):
            world.add_robot(cart_urdf, ("elbow",), [0.0])
        world.add_robot(cart_urdf, ("shoulder",), [0.0])
        with pytest.raises(RobotError, match="a robot already"):
            world.add_robot(cart_urdf, ("shoulder",), [0.0])
        with pytest.raises(RobotError, match="q must be 1 finite"):
            world.command_joints([0.0, 1.0])
        with pytest.raises(RobotError, match="q must be 1 finite"):
            world.command_joints([float("nan")])
        with pytest.raises(RobotError, match="no base"):
            world.command_base(0.1, 0.0)
        with pytest.raises(RobotError, match="no gripper"):
            world.command_gripper(0.0)
        with pytest.raises(RobotError, match="pan and a tilt"):
            world.command_head(0.0, 0.0)
        with pytest.raises(UnknownLinkError, match=r"'hand'.*'arm'"):
            world.robot.link_pose("hand")
        with pytest.raises(SceneError, match="in the world already"):
            world.add_body(Sphere("wall", np.eye(4), 0.1))


def _panda_table(thing) -> Scene:
    table = Box("table", planar_pose(0.5, 0, 0.2), (0.5, 0.8, 0.4))
    return Scene(
        "panda", static=(Box("floor", planar_pose(0, 0, -0.05), (4.0, 4.0, 0.1)), table), objects=(thing,)
    )


def _reach(world: World, height: float, q: np.ndarray) -> np.ndarray:
    """Joint angles that put the point between the fingers at (0.5, 0, height), pointing down."""
    robot = world.robot
    tip, down = robot.link_index["panda_grasptarget"], [1.0, 0.0, 0.0, 0.0]
    robot.reset(q)
    for _ in range(30):
        found = pybullet.calculateInverseKinematics(
            robot.body, tip, [0.5, 0, height], down, maxNumIterations=100, physicsClientId=world.client
        )
        robot.reset(found[:7])
    assert robot.link_pose("panda_grasptarget")[:3, 3] == pytest.approx(np.array([0.5, 0, height]), abs=1e-3)
    return np.array(found[:7])


def _move(world: World, start: np.ndarray, end: np.ndarray, duration: float = 2.0) -> None:
    for s in np.linspace(0, 1, 40):
        world.command_joints(start + s * (end - start))
        world.step(duration / 40)
    world.step(0.3)


@pytest.mark.parametrize("kind", ["box", "can"])
def test_the_hand_lifts_and_holds_an_object(kind):
    thing = (small_box if kind == "box" else can)("thing").at(planar_pose(0.5, 0, 0.46))
    with World(_panda_table(thing)) as world:
        q = np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.3, 0.785])
        world.add_robot(PANDA_URDF, PANDA_JOINTS, q, gripper=Hand())
        high = _reach(world, 0.585, q)
        low = _reach(world, 0.485, high)
        world.robot.reset(high)
        _move(world, high, low)
        assert world.object_pose("thing")[:3, 3] == pytest.approx(thing.pose[:3, 3], abs=3e-3)
        assert world.contacts() == []
        world.command_gripper(0.0)
        world.step(1.0)
        links = {c.link for c in world.contacts() if c.body == "thing"}
        assert links == {"panda_leftfinger", "panda_rightfinger"}
        assert world.contacts(ignore=["thing"]) == []
        _move(world, low, high)
        lifted = world.object_pose("thing")
        assert lifted[2, 3] - thing.pose[2, 3] == pytest.approx(0.1, abs=0.01)
        world.step(2.0)
        held = world.object_pose("thing")
        assert np.linalg.norm(held[:3, 3] - lifted[:3, 3]) < 2e-3
        assert held[2, 2] > 0.99, "it stays upright"
        world.command_gripper(1.0)
        world.step(1.0)
        assert world.object_pose("thing")[2, 3] < 0.5, "an opened hand drops it"


def test_a_held_object_cannot_be_pushed_sideways_between_the_fingers():
    thing = small_box("thing").at(planar_pose(0.5, 0, 0.46))
    with World(_panda_table(thing)) as world:
        q = np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.3, 0.785])
        world.add_robot(PANDA_URDF, PANDA_JOINTS, q, gripper=Hand())
        high = _reach(world, 0.585, q)
        _reach(world, 0.485, high)
        world.command_gripper(0)
        world.step(1.0)
        _move(world, world.robot_state()[0], high)
        before = world.object_pose("thing")[:3, 3]
        # Along the fingers' axis, which is the world's y, and less than the grip can bear.
        for _ in range(240):
            body = world.body_id("thing")
            force, at = [0.0, 8.0, 0.0], world.object_pose("thing")[:3, 3].tolist()
            pybullet.applyExternalForce(
                body, -1, force, at, pybullet.WORLD_FRAME, physicsClientId=world.client
            )
            world.step()
        assert np.linalg.norm(world.object_pose("thing")[:3, 3] - before) < 3e-3


def test_a_weak_grip_does_not_lift():
    thing = small_box("thing").at(planar_pose(0.5, 0, 0.46))
    with World(_panda_table(thing)) as world:
        q = np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.3, 0.785])
        world.add_robot(PANDA_URDF, PANDA_JOINTS, q, gripper=Hand())
        high = _reach(world, 0.585, q)
        low = _reach(world, 0.485, high)
        world.command_gripper(0.0, force=0.2)
        world.step(1.0)
        _move(world, low, high)
        assert world.object_pose("thing")[2, 3] < 0.5
