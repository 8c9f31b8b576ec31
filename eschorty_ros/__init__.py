"""Event-based Scheimpflug LiDAR: camera, laser line and stage in, point cloud out.

The names below are the public Python interface, imported on first use; all others may change.

    A recording, here a simulated one, becomes a cloud:

    >>> import eschorty_ros as es
    >>> from eschorty_ros.simulation import scenes, world
    >>> build = es.load_calibration("config_3")
    >>> recording = world.simulate_recording("rec", scenes.named("steps"), build, stop_mm=12.0)
    >>> cloud = es.reconstruct("rec", centroid="mode_mean")
    >>> cloud.save("cloud.ply")
    >>> cloud.warnings, bool(cloud.score().error_median_mm < 0.4)
    ((), True)

    A stream of a camera and a stage of your own becomes points while it comes:

    >>> reconstructor = es.Reconstructor(build, es.Modulation(frequency_hz=70.0))
    >>> stage, count = es.StageTrack(), 0
    >>> stage.append(recording.stage_samples["t_us"], recording.stage_samples["position_mm"])
    >>> def placed(profiles):
    ...     stage_mm = stage.position_mm(profiles.t_us)
    ...     return es.place(profiles, reconstructor.model, stage_mm, build.stage_direction)
    >>> for data in es.RawReader("rec/events.raw"):  # the camera's next bytes, EVT3
    ...     count += len(placed(reconstructor.push(data)))
    >>> count + len(placed(reconstructor.flush())) == len(cloud.points)
    True
"""

from importlib import import_module
from pkgutil import extend_path
from typing import Any

# The generated msg, srv and action modules live in an installed folder of the same name; this
# lets the sources be used in place beside them.
__path__ = extend_path(__path__, __name__)
__version__ = "0.1.0"

_PLACES = {
    "api": ("Cloud", "reconstruct"),
    "core.base.errors": ("EschortyError",),
    "core.clocks": ("StageTrack",),
    "core.modulation": ("Modulation",),
    "core.optics": ("Calibration", "load_calibration", "save_calibration"),
    "core.reconstruction": ("Profiles", "Reconstructor", "Settings", "place"),
    "core.storage": (
        "POINT_DTYPE", "Recording", "load_recording", "read_cloud", "write_cloud",
        "write_laser_yaml", "write_stage_csv",
    ),
    "core.storage.raw_file": ("RawReader", "write_events_raw"),
}  # fmt: skip
_PLACE = {name: place for place, names in _PLACES.items() for name in names}
__all__ = sorted(_PLACE)


def __getattr__(name: str) -> Any:
    """Return a public name; its module is imported now."""
    if name not in _PLACE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_PLACE[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
