"""From the camera's bytes to profiles and points: the names other parts of the package use."""

from __future__ import annotations

from eschorty_ros.core.reconstruction.offline import Result, reconstruct_recording
from eschorty_ros.core.reconstruction.profiles import (
    Profiles,
    add_stage,
    place,
    place_link,
    stage_offset_m,
)
from eschorty_ros.core.reconstruction.reconstructor import Reconstructor
from eschorty_ros.core.reconstruction.settings import Settings

__all__ = [
    "Profiles",
    "Reconstructor",
    "Result",
    "Settings",
    "add_stage",
    "place",
    "place_link",
    "reconstruct_recording",
    "stage_offset_m",
]
