"""The driver of the Prophesee EVK4, its settings and their ranges."""

from eschorty_ros.hardware.camera.anti_flicker import ANTI_FLICKER_HZ, AntiFlicker
from eschorty_ros.hardware.camera.biases import BIASES, load_bias_file, save_bias_file
from eschorty_ros.hardware.camera.event_rate import ERC_RATE_MAX
from eschorty_ros.hardware.camera.event_trail import TRAIL_THRESHOLD_US, TRAIL_TYPES
from eschorty_ros.hardware.camera.evk4 import Evk4
from eschorty_ros.hardware.camera.imx636 import HEIGHT, WIDTH
from eschorty_ros.hardware.camera.monitors import PACKET_PERIOD_US
from eschorty_ros.hardware.camera.pixel_selection import Window, windows_of
from eschorty_ros.hardware.camera.settings import CameraSettings

__all__ = [
    "ANTI_FLICKER_HZ",
    "BIASES",
    "ERC_RATE_MAX",
    "HEIGHT",
    "PACKET_PERIOD_US",
    "TRAIL_THRESHOLD_US",
    "TRAIL_TYPES",
    "WIDTH",
    "AntiFlicker",
    "CameraSettings",
    "Evk4",
    "Window",
    "load_bias_file",
    "save_bias_file",
    "windows_of",
]
