"""Scenes for the laser sheet: analytic surfaces and meshes by name."""

from eschorty_ros.simulation.scenes.face import EAR_OFF_MM, Face
from eschorty_ros.simulation.scenes.leaves import LEVELS, SEPARATION_MM, Leaves
from eschorty_ros.simulation.scenes.mesh import Mesh
from eschorty_ros.simulation.scenes.names import NAMES, RECEDING_MM, named
from eschorty_ros.simulation.scenes.open3d_module import load_open3d
from eschorty_ros.simulation.scenes.posts import Post, Posts, bench
from eschorty_ros.simulation.scenes.scene import Scene
from eschorty_ros.simulation.scenes.surfaces import Plane, Sphere, Steps
from eschorty_ros.simulation.scenes.within_range import WithinRange

__all__ = [
    "EAR_OFF_MM",
    "LEVELS",
    "NAMES",
    "RECEDING_MM",
    "SEPARATION_MM",
    "Face",
    "Leaves",
    "Mesh",
    "Plane",
    "Post",
    "Posts",
    "Scene",
    "Sphere",
    "Steps",
    "WithinRange",
    "bench",
    "load_open3d",
    "named",
]
