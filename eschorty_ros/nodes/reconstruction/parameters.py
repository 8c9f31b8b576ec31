"""Parameters of the reconstruction node."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eschorty_ros.control.calibration_sequence import CAPTURE_MAX_S
from eschorty_ros.control.scan_sequence import check_laser
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.files import bare_name_fault
from eschorty_ros.core.calibration import METHODS
from eschorty_ros.core.modulation import FREQUENCY_MAX_HZ, WAVEFORMS, Modulation
from eschorty_ros.core.reconstruction import Settings
from eschorty_ros.nodes.ros.frames import FRAME_PREFIX
from eschorty_ros.nodes.ros.parameters import Param, from_settings

TABLE = (
    Param("calibration", "config_3", "calibration: a name in config/ or a file's path"),
    Param("frequency", 0.0, "modulation frequency; 0: the laser node's settings", "Hz",
          0.0, FREQUENCY_MAX_HZ, dynamic=True),
    Param("duty", 0.5, "duty where frequency is given", "", 0.001, 0.999, dynamic=True),
    Param("waveform", "square", "waveform where frequency is given",
          choices=WAVEFORMS, dynamic=True),
    Param("clock_timeout", 2.0, "longest wait for camera/clock if it has a publisher; then the "
          "packets' stamps are used", "s", 0.0, 60.0),
    Param("packet_period", 0.004, "time over which the camera collects events before it sends "
          "them: its mipi_frame_period, which drivers leave at 4 ms", "s", 0.0, 0.1),
    Param("stage_gap", 0.5, "longest time between two stage samples that is bridged; 0 bridges any",
          "s", 0.0, 1e6, dynamic=True),
    # Longer than the 3 s after which DDS repeats what got lost at the end of a burst.
    Param("stage_timeout", 6.0, "longest wait of a point for its stage position", "s", 0.1, 60.0),
    Param("camera_roi", "leave", "the camera's own region of interest: leave it as it is, or let "
          "it follow columns and ranges, so that it sends nothing else",
          choices=("leave", "follow")),
    Param("packets_max", 2000, "packets that may wait for reconstruction", "packets", 10, 100_000),
    Param("profile_rate_max", 200.0, "most live profiles per second", "Hz", 0.1, 20_000.0),
    Param("record", "", "folder into which every scan is recorded, one folder each; empty: no "
          "recordings", dynamic=True),
    Param("record_name", "", "name of the next recording; empty: the scan's", dynamic=True),
    Param("calibration_folder", "", "folder for calibrations; empty: eschorty in ROS's home"),
    Param("calibration_paths", False, "load_calibration and save_calibration take paths, too: of "
          "any file that the node may read or write"),
    Param("auto_calibrate", False, "calibrate once as soon as the other nodes are ready"),
    Param("distances", "posts", "auto_calibrate: targets, a file's name in config/ or a path"),
    Param("method", "joint", "auto_calibrate: method of the fit", choices=METHODS),
    Param("capture_time", 1.0, "auto_calibrate: time of light on the targets", "s",
          1e-3, CAPTURE_MAX_S),
    Param("node_timeout", 60.0, "calibration: longest wait for the other nodes", "s", 0.1, 600.0),
    Param("service_timeout", 5.0, "calibration: longest wait for an answer", "s", 0.1, 60.0),
    Param("events_timeout", 3.0, "calibration: longest pause of the events while the laser is on",
          "s", 0.1, 60.0),
    Param("publish_tf", True, "publish /tf and /tf_static"),
    FRAME_PREFIX,
    *from_settings(Settings, dynamic=True),
)  # fmt: skip


def modulation_override(values: Mapping[str, Any]) -> Modulation | None:
    """Return the modulation in the parameters, ``None`` when the laser node's is to be used."""
    if not values["frequency"]:
        return None
    check_laser(values["frequency"], values["duty"])
    return Modulation(values["frequency"], values["duty"], values["waveform"])


def expanded_folder(name: str, path: str) -> Path:
    """Return the folder that the parameter ``name`` gives, whose ``~`` is the home folder.

    Raises ``ArgumentError`` where there is no such home.
    """
    try:
        return Path(path).expanduser().resolve()
    except RuntimeError:
        raise ArgumentError(
            f"{name} is {path!r}; there is no such home folder, give the whole path"
        ) from None


def check_recording(values: Mapping[str, Any]) -> None:
    """Raise ``ArgumentError`` unless a recording has, if any, a folder and a name in it."""
    expanded_folder("record", values["record"])
    name = values["record_name"]
    if name and (fault := bare_name_fault("record_name", name)):
        raise ArgumentError(fault)
