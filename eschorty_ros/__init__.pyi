"""Types of the public names, which `__init__.py` imports on first use, unseen by type checkers."""

from eschorty_ros.api import Cloud as Cloud
from eschorty_ros.api import reconstruct as reconstruct
from eschorty_ros.core.base.errors import EschortyError as EschortyError
from eschorty_ros.core.clocks import StageTrack as StageTrack
from eschorty_ros.core.modulation import Modulation as Modulation
from eschorty_ros.core.optics import Calibration as Calibration
from eschorty_ros.core.optics import load_calibration as load_calibration
from eschorty_ros.core.optics import save_calibration as save_calibration
from eschorty_ros.core.reconstruction import Profiles as Profiles
from eschorty_ros.core.reconstruction import Reconstructor as Reconstructor
from eschorty_ros.core.reconstruction import Settings as Settings
from eschorty_ros.core.reconstruction import place as place
from eschorty_ros.core.storage import POINT_DTYPE as POINT_DTYPE
from eschorty_ros.core.storage import Recording as Recording
from eschorty_ros.core.storage import load_recording as load_recording
from eschorty_ros.core.storage import read_cloud as read_cloud
from eschorty_ros.core.storage import write_cloud as write_cloud
from eschorty_ros.core.storage import write_laser_yaml as write_laser_yaml
from eschorty_ros.core.storage import write_stage_csv as write_stage_csv
from eschorty_ros.core.storage.raw_file import RawReader as RawReader
from eschorty_ros.core.storage.raw_file import write_events_raw as write_events_raw

__version__: str
