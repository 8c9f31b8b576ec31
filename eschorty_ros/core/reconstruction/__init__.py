"""From the camera's bytes to profiles and points."""

from eschorty_ros.core.reconstruction.live_cloud import LIVE_DTYPE, LIVE_SPAN_NS, live_points
from eschorty_ros.core.reconstruction.missing_points import cause_of_few, without_modulation
from eschorty_ros.core.reconstruction.offline import (
    Result,
    reconstruct_recording,
    recorded_settings,
    stage_speed_mm_s,
)
from eschorty_ros.core.reconstruction.pass_lag import PassLag, pass_lag, take_off_lag
from eschorty_ros.core.reconstruction.profiles import (
    Profiles,
    add_stage,
    place,
    place_link,
    stage_offset_m,
)
from eschorty_ros.core.reconstruction.reconstructor import Reconstructor
from eschorty_ros.core.reconstruction.region import SensorWindow, region_window
from eschorty_ros.core.reconstruction.settings import NOISE_FILTERS, Settings
from eschorty_ros.core.reconstruction.warm_up import warm_up

__all__ = [
    "LIVE_DTYPE",
    "LIVE_SPAN_NS",
    "NOISE_FILTERS",
    "PassLag",
    "Profiles",
    "Reconstructor",
    "Result",
    "SensorWindow",
    "Settings",
    "add_stage",
    "cause_of_few",
    "live_points",
    "pass_lag",
    "place",
    "place_link",
    "reconstruct_recording",
    "recorded_settings",
    "region_window",
    "stage_offset_m",
    "stage_speed_mm_s",
    "take_off_lag",
    "warm_up",
    "without_modulation",
]
