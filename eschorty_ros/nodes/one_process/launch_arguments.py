"""The launch files' arguments, checked, and the nodes that they describe; needs no ``launch``."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix

from eschorty_ros.control.scan_sequence import ScanRequest, check_request
from eschorty_ros.core.base.errors import ArgumentError, EschortyError
from eschorty_ros.core.base.files import config_path
from eschorty_ros.core.calibration import METHODS, read_distances
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.storage import load_recording
from eschorty_ros.emulation.bench.devices import BenchSettings
from eschorty_ros.emulation.bench.physics import TRIGGERS
from eschorty_ros.nodes.one_process.composition import NAMESPACE, Tables
from eschorty_ros.nodes.one_process.hardware_file import TABLES, read_parameters
from eschorty_ros.nodes.reconstruction.auto_calibration import find_distances
from eschorty_ros.nodes.ros.conversions import mm_from_m
from eschorty_ros.nodes.ros.drivers import REAL
from eschorty_ros.nodes.ros.parameters import Param
from eschorty_ros.nodes.stage.parameters import stage_limits
from eschorty_ros.simulation.pixels import PRESETS
from eschorty_ros.simulation.scenes import NAMES, named
from eschorty_ros.simulation.world import Effects

EVENTS = f"{NAMESPACE}/camera/events"
BOOLEAN = ("true", "false")
_BENCH = BenchSettings()


def shared_file(name: str) -> Path:
    """Return a file in ``config/``."""
    return config_path(name) or Path(name)


_DEVICES = (
    Param("fake", "true", "true: real drivers at an emulated bench; false: at real devices",
          choices=BOOLEAN),
    Param("camera", "true", "false: another driver publishes camera/events", choices=BOOLEAN),
    Param("trigger", _BENCH.trigger,
          "what is wired to the camera's trigger input: none, laser or stage", choices=TRIGGERS),
    Param("pixels", _BENCH.pixels, "event pixels of an emulated camera", choices=tuple(PRESETS)),
    Param("effects", _BENCH.effects,
          "effects of an emulated world, such as ambient=0.5,occlusion=1"),
    Param(
        "frequency",
        "70.0",
        "laser modulation, Hz, 16 to 20000; one profile per period, or per several where one has "
        "too few events",
    ),
)  # fmt: skip
_FILE = Param(
    "parameters",
    str(shared_file("parameters.yaml")),
    "YAML file of parameters by node; what it holds overrides the other arguments",
)
_RVIZ = Param("rviz", "false", "true: show cloud, live profile and frames in RViz", choices=BOOLEAN)

SCAN = (
    *_DEVICES,
    _FILE,
    Param("scene", _BENCH.scene, f"what stands on an emulated bench: {', '.join(NAMES)} or a mesh"),
    Param("calibration", "config_3", "optical build: a name in config/ or the path of a file"),
    Param("speed", "0.05", "stage speed, m/s"),
    Param("start", "0.01", "stage position where the sweep begins, m"),
    Param("stop", "0.11", "stage position where the sweep ends, m"),
    Param("auto_scan", "true", "true: scan once when every node is ready", choices=BOOLEAN),
    _RVIZ,
)  # fmt: skip
CALIBRATE = (
    *_DEVICES,
    _FILE,
    Param("scene", "posts", "what stands on an emulated bench: a scene's name or a mesh"),
    Param("calibration", "config_3", "optical build as designed: a name in config/ or a file"),
    Param("as_built", "config_3_as_built", "build of the emulated bench"),
    Param("distances", "posts", "what is known of the targets: a name in config/ or a CSV file"),
    Param("method", "joint", "what is fitted: k', b' and more under priors, or k' and b' alone",
          choices=METHODS),
    Param("capture_time", "1.0", "for how long the targets are lit, s"),
    Param("calibration_folder", "", "where calibrations are written; empty: eschorty in ~/.ros"),
    Param("auto_calibrate", "true", "true: calibrate once when every node is ready; false: wait "
          "for goals of the action calibrate", choices=BOOLEAN),
)  # fmt: skip
REPLAY = (
    Param("recording", None, "folder with events.raw, stage.csv, laser.yaml, calibration.yaml"),
    Param("rate", "1.0", "speed of the replay against real time; 0 is as fast as possible"),
    _FILE,
    _RVIZ,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Description:
    """The nodes, bench and view that a launch file starts."""

    nodes: Tables
    """Parameters by node."""
    bench: dict[str, str] | None
    """Options of ``eschorty-bench``; ``None`` without an emulated bench."""
    view: str
    """RViz's view to show; empty for none."""


def scan(given: Mapping[str, str]) -> Description:
    """Return the nodes of ``scan.launch.py`` for the texts of its arguments.

    Raises ``EschortyError`` for an argument or a file that a node would refuse; names it.
    """
    _check_choices(SCAN, given)
    nodes = _instrument(given, ())
    nodes["scanner"] = _typed(given, "scanner", ("auto_scan", "start", "stop", "speed"))
    values = _with_file(nodes, given)
    _check_build(given, values, given["calibration"])
    sweep = values["scanner"]
    if sweep["auto_scan"]:
        start, stop, speed = (mm_from_m(sweep[name]) for name in ("start", "stop", "speed"))
        check_request(
            ScanRequest("", start, stop, speed, sweep["frequency"], sweep["duty"]),
            stage_limits(values["stage"]),
        )
    return _described(given, nodes, given["calibration"])


def calibrate(given: Mapping[str, str]) -> Description:
    """Return the nodes of ``calibrate.launch.py``; see ``scan``."""
    _check_choices(CALIBRATE, given)
    names = ("calibration_folder", "distances", "method", "capture_time", "auto_calibrate")
    nodes = _instrument(given, names)
    values = _with_file(nodes, given)
    _check_build(given, values, given["as_built"])
    if values["reconstruction"]["auto_calibrate"]:
        with _naming("distances"):
            read_distances(find_distances(values["reconstruction"]["distances"]))
    return _described(given, nodes, given["as_built"])


def replay(given: Mapping[str, str]) -> Description:
    """Return the nodes of ``replay.launch.py``; see ``scan``."""
    _check_choices(REPLAY, given)
    nodes: Tables = {
        "reconstruction": {
            "calibration": str(Path(given["recording"]) / "calibration.yaml"),
            # A recording's stage track has no gaps that must be refused.
            "stage_gap": 0.0,
            f"qos_overrides.{EVENTS}.subscription.reliability": "reliable",
        },
        "replay": _typed(given, "replay", ("recording", "rate")),
    }
    values = _with_file(nodes, given)
    with _naming("recording"):
        # The settings of the recorded scan, unless the file has others.
        settings = load_recording(values["replay"]["recording"]).settings
    nodes["reconstruction"] = settings | nodes["reconstruction"]
    return _described(given, nodes, None)


def _instrument(given: Mapping[str, str], reconstruction: tuple[str, ...]) -> Tables:
    """Return parameters of devices and reconstruction.

    At an emulated bench the events are reliable at both ends, because its camera can wait.
    """
    fake, ours = given["fake"] == "true", given["camera"] == "true"
    reliability = "reliable" if fake and ours else "best_effort"
    nodes: Tables = {
        name: {"driver": "fake" if fake else driver}
        for name, driver in REAL.items()
        if ours or name != "camera"
    }
    nodes["laser"] |= _typed(given, "laser", ("frequency",))
    nodes["reconstruction"] = {
        **_typed(given, "reconstruction", ("calibration", *reconstruction)),
        "trigger_source": given["trigger"],
        f"qos_overrides.{EVENTS}.subscription.reliability": reliability,
    }
    if ours:
        nodes["camera"] |= {
            "trigger_in_mode": "disabled" if given["trigger"] == "none" else "external",
            f"qos_overrides.{EVENTS}.publisher.reliability": reliability,
        }
    else:
        # Another driver has no heartbeat.
        nodes["laser"]["watch"] = "stage"
    return nodes


def _described(given: Mapping[str, str], nodes: Tables, built: str | None) -> Description:
    """Return the description of checked nodes, the bench with the build ``built``."""
    view = ""
    if "rviz" in given and given["rviz"] == "true":
        view = str(shared_file("scan.rviz"))
        try:
            get_package_prefix("rviz2")
        except PackageNotFoundError as error:
            raise ArgumentError(
                "argument rviz is true and the package rviz2 is not installed; install it, or "
                "leave rviz out"
            ) from error
    bench = None
    if built is not None and given["fake"] == "true":
        bench = {name: given[name] for name in ("scene", "pixels", "effects", "trigger")}
        bench["calibration"] = built
    return Description(nodes, bench, view)


def _check_choices(arguments: tuple[Param, ...], given: Mapping[str, str]) -> None:
    for argument in arguments:
        if argument.choices:
            argument.check(given[argument.name], "argument")


def _typed(given: Mapping[str, str], node: str, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the parameters of ``node`` that arguments of their names give."""
    table = {param.name: param for param in TABLES[node]}
    values = {name: _READERS[type(table[name].default)](given[name]) for name in names}
    for name, value in values.items():
        table[name].check(value, "argument")
    return values


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


_READERS: dict[type, Callable[[str], Any]] = {
    bool: lambda text: text == "true",
    float: _number,
    str: str,
}


def _with_file(nodes: Tables, given: Mapping[str, str]) -> Tables:
    """Add the file's parameters to those of the arguments; return them with all defaults."""
    with _naming("parameters"):
        file = read_parameters(given["parameters"])
    for name, table in nodes.items():
        table |= file.get(name, {})
    return {
        name: {param.name: param.default for param in TABLES[name]} | table
        for name, table in nodes.items()
    }


def _check_build(given: Mapping[str, str], values: Tables, built: str) -> None:
    """Refuse a calibration, or a scene of an emulated bench, that cannot be used."""
    with _naming("calibration"):
        load_calibration(values["reconstruction"]["calibration"])
    if given["fake"] == "true":
        with _naming("scene"):
            named(given["scene"])
        with _naming("effects"):
            Effects.parse(given["effects"])
        with _naming("as_built" if "as_built" in given else "calibration"):
            load_calibration(built)


@contextlib.contextmanager
def _naming(name: str) -> Iterator[None]:
    """Begin the text of a refusal with the argument's name."""
    try:
        yield
    except EschortyError as error:
        raise ArgumentError(f"argument {name}: {error}") from error
