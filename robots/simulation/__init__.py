"""The pybullet world that stands in for the real one: scenes, physics, a depth camera and its noise."""

from robots.simulation.base import DifferentialDrive, DriveConfig
from robots.simulation.camera import DepthCamera, DepthFrame, PinholeCamera
from robots.simulation.contacts import Contact
from robots.simulation.depth_noise import DepthNoise, DepthNoiseConfig
from robots.simulation.mesh_sdf import MeshField
from robots.simulation.mobile_robot import SimulatedMobileRobot
from robots.simulation.primitives import Box, Cylinder, Primitive, Sphere
from robots.simulation.recording import Recording
from robots.simulation.rooms import GraspTask
from robots.simulation.scene_sdf import SceneField
from robots.simulation.scenes import Scene, available_scenes, load_urdf_scene, make_scene
from robots.simulation.simulated_robot import MotorConfig, SimulatedRobot
from robots.simulation.truth import Truth, load_truth, save_truth
from robots.simulation.urdf_object import UrdfObject, load_object
from robots.simulation.world import World

__all__ = [
    "Box",
    "Contact",
    "Cylinder",
    "DepthCamera",
    "DepthFrame",
    "DepthNoise",
    "DepthNoiseConfig",
    "DifferentialDrive",
    "DriveConfig",
    "GraspTask",
    "MeshField",
    "MotorConfig",
    "PinholeCamera",
    "Primitive",
    "Recording",
    "Scene",
    "SceneField",
    "SimulatedMobileRobot",
    "SimulatedRobot",
    "Sphere",
    "Truth",
    "UrdfObject",
    "World",
    "available_scenes",
    "load_object",
    "load_truth",
    "load_urdf_scene",
    "make_scene",
    "save_truth",
]
