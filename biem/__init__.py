"""Vesicle suspensions in two-dimensional Stokes flow by boundary integrals."""

from biem.membrane.maps import ExactMaps, MembraneMaps
from biem.run.simulate import simulate
from biem.run.trajectory import read_trajectory
from biem.scene.config import load_scene
from biem.stokes.single_layer import single_layer

__version__ = "0.1.0"
__all__ = ["ExactMaps", "MembraneMaps", "load_scene", "read_trajectory", "simulate", "single_layer"]
