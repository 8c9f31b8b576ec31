"""rosbag2 files by the library `rosbags`: message types, messages in and out; no ROS needed."""

from __future__ import annotations

import contextlib
import importlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from eschorty_ros.core.base.errors import ArgumentError, EschortyError, FormatError
from eschorty_ros.core.storage import BAG_FILE, EVENTS_FILE

STORAGES = ("mcap", "sqlite3")
_COMPRESSED = ".zstd"
_ENDINGS = tuple(f"{name}{end}" for name in (".mcap", ".db3") for end in ("", _COMPRESSED))

EVENTS = "event_camera_msgs/msg/EventPacket"
ODOMETRY = "nav_msgs/msg/Odometry"
LASER = "eschorty_ros/msg/LaserState"
TRIGGER = "eschorty_ros/msg/PositionTrigger"
CALIBRATION = "eschorty_ros/msg/ActiveCalibration"
CLOCK = "sensor_msgs/msg/TimeReference"

TOPICS = {
    EVENTS: "/eschorty/camera/events",
    ODOMETRY: "/eschorty/stage/odom",
    LASER: "/eschorty/laser/state",
    TRIGGER: "/eschorty/stage/trigger",
    CALIBRATION: "/eschorty/reconstruction/calibration",
    CLOCK: "/eschorty/camera/clock",
}
"""Message type and its topic; another topic, but of a clock, is taken when it is the only one."""

_HEADER = "std_msgs/Header header\n"
DEFINITIONS = {
    EVENTS: _HEADER + "uint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
    "string encoding\nbool is_bigendian\nuint8[] events\n",
    LASER: "uint8 OUTPUT_OFF=0\nuint8 OUTPUT_ON=1\nuint8 OUTPUT_UNKNOWN=2\n" + _HEADER
    + "uint8 requested\nuint8 output\nbool armed\nbool interlock_open\nstring waveform\n"
    "float64 frequency\nfloat64 duty\nbuiltin_interfaces/Time phase_epoch\n"
    "builtin_interfaces/Time output_since\nstring reason\n",
    TRIGGER: _HEADER + "float64 first\nfloat64 interval\nuint32 count\n",
    CALIBRATION: _HEADER + "string name\nstring id\nstring date\nstring file\nuint32 columns\n"
    "uint32 rows\nstring[] parameters\nfloat64[] values\nfloat64 residual_rms\n"
    "float64 range_min\nfloat64 range_max\nstring yaml\n",
}  # fmt: skip
"""Our messages and EventPacket, which the library does not know."""


@dataclass(frozen=True, slots=True)
class BagMessage:
    """A message of a bag: its type, the ROS time (ns) of its arrival, its fields by name."""

    kind: str
    t_ns: int
    fields: Any


def is_bag(path: Path) -> bool:
    """Return whether a path is that of a bag: its folder or one file of it."""
    if path.is_dir():
        files = [] if (path / EVENTS_FILE).is_file() else _files_in(path)
        return (path / BAG_FILE).is_file() or bool(files)
    return path.name.lower().endswith(_ENDINGS)


def _files_in(folder: Path) -> list[Path]:
    return [file for file in sorted(folder.iterdir()) if file.is_file() and is_bag(file)]


def _to_open(path: Path) -> Path:
    """Return the folder of a bag, or its only file; a killed recorder writes no metadata."""
    if path.is_dir() and not (path / BAG_FILE).is_file():
        files = _files_in(path)
        if len(files) > 1:
            raise FormatError(
                f"{path} has {len(files)} files of bags and no {BAG_FILE}; give one of them, or "
                "run `ros2 bag reindex`"
            )
        path = files[0] if files else path
    if path.suffix.lower() == _COMPRESSED:
        raise FormatError(f"{path} is compressed; run unzstd on it")
    return path


class BagReader:
    """The messages of a bag that a reconstruction needs.

    Raises ``FormatError`` when it cannot be read, or two topics of a type could be meant.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        # The definitions in a bag are not used: the library cannot parse every one of ROS's own.
        self._store = _store()
        with self._named():
            self._reader = _rosbags("rosbag2").Reader(_to_open(path))
        self._chosen: dict[str, Any] = {}

    def __enter__(self) -> BagReader:
        try:
            with self._named():
                self._reader.open()
                self._choose()
        except EschortyError:
            self.__exit__()
            raise
        return self

    def _choose(self) -> None:
        for kind, topic in TOPICS.items():
            found = [item for item in self._reader.connections if item.msgtype == kind]
            name = topic.removeprefix("/eschorty")
            ours = [item for item in found if item.topic.endswith(name)]
            found = ours or ([] if kind == CLOCK else found)
            topics = sorted({item.topic for item in found})
            if len(topics) > 1:
                raise FormatError(
                    f"{self.path} has {kind} on {', '.join(topics)}; leave one of them in it"
                )
            if found and found[0].digest not in ("", self._store.hash_rihs01(kind)):
                raise FormatError(
                    f"{self.path} has another {kind} than this version; convert it with the "
                    "version that recorded it"
                )
            if found:
                self._chosen[kind] = found

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(Exception):
            self._reader.close()

    def __contains__(self, kind: str) -> bool:
        """Return whether the bag has messages of a type."""
        return any(item.msgcount for item in self._chosen.get(kind, ()))

    def counts(self) -> dict[str, int]:
        """Return the number of messages of each topic."""
        return {item.topic: item.msgcount for item in self._reader.connections}

    @property
    def custom(self) -> dict[str, str]:
        """Custom data of the bag's metadata."""
        return dict(self._reader.storage.metadata.custom or {})

    def messages(self, *kinds: str) -> Iterator[BagMessage]:
        """Yield the messages of these types in the order of their arrival."""
        connections = [item for kind in kinds for item in self._chosen.get(kind, ())]
        if not connections:
            return
        with self._named():
            for connection, t_ns, data in self._reader.messages(connections):
                fields = self._store.deserialize_cdr(data, connection.msgtype)
                yield BagMessage(connection.msgtype, t_ns, fields)

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        """Raise the library's errors, whose classes are many, as one that names the bag."""
        try:
            yield
        except (EschortyError, GeneratorExit):
            raise
        except Exception as error:
            raise FormatError(
                f"cannot read the bag {self.path}: {error or type(error).__name__}; repair it: a "
                f"cut .mcap with `mcap recover`, its {BAG_FILE} with `ros2 bag reindex`"
            ) from error


class BagWriter:
    """Writes a new bag on the instrument's topics.

    - ``path``: Its folder; made here.
    - ``storage``: ``mcap`` or ``sqlite3``.
    - ``custom``: Custom data of the bag's metadata.
    """

    def __init__(self, path: Path, storage: str, custom: dict[str, str]) -> None:
        if storage not in STORAGES:
            raise ArgumentError(f"storage is {storage!r}; choose {' or '.join(STORAGES)}")
        if path.exists():
            raise ArgumentError(f"{path} exists; give the name of a new bag")
        module = _rosbags("rosbag2")
        self._path = path
        self._store = _store()
        plugin = module.StoragePlugin[storage.upper()]
        self._writer = module.Writer(path, version=8, storage_plugin=plugin)
        for key, value in custom.items():
            self._writer.set_custom_data(key, value)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        whole = False
        try:
            self._writer.close()
            whole = kind is None
        finally:
            if not whole:
                # Half a bag would look complete.
                shutil.rmtree(self._path, ignore_errors=True)

    def write(self, kind: str, t_ns: int, **fields: Any) -> None:
        """Append a message; fields that are not given are 0 or empty."""
        if kind not in self._connections:
            self._connections[kind] = self._writer.add_connection(
                TOPICS[kind], kind, typestore=self._store
            )
        data = self._store.serialize_cdr(_filled(self._store, kind, fields), kind)
        self._writer.write(self._connections[kind], t_ns, data)


def _filled(store: Any, kind: str, values: dict[str, Any]) -> Any:
    """Return a message of a type; messages in it may be given as dictionaries."""
    made: dict[str, Any] = {}
    for name, (node, detail) in store.fielddefs[kind][1]:
        value = values.get(name)
        form = node.name
        if form == "NAME":
            known = value is None or isinstance(value, dict)
            made[name] = _filled(store, detail, value or {}) if known else value
        elif form == "BASE":
            empty: Any = "" if detail[0] == "string" else False if detail[0] == "bool" else 0
            made[name] = empty if value is None else value
        else:
            (inner, (base, _)), length = detail
            assert inner.name == "BASE"
            if base == "string":
                made[name] = list(value or [])
            elif value is None:
                made[name] = np.zeros(length, np.dtype(base if base != "octet" else "uint8"))
            else:
                made[name] = value
    return store.types[kind](**made)


def _store() -> Any:
    """Return a store of the message types: ROS's own, EventPacket and ours."""
    types = _rosbags("typesys")
    store = types.get_typestore(types.Stores.ROS2_JAZZY)
    for kind, text in DEFINITIONS.items():
        store.register(types.get_types_from_msg(text, kind))
    return store


def _rosbags(name: str) -> ModuleType:
    try:
        return importlib.import_module(f"rosbags.{name}")
    except ImportError as error:
        raise EschortyError(
            f"bags need rosbags, which does not import here ({error}); run: pip install rosbags"
        ) from error


def stamp(t_ns: int) -> dict[str, int]:
    """Return the fields of a ROS time; raises ``ArgumentError`` for one that these do not hold."""
    sec, nanosec = divmod(t_ns, 1_000_000_000)
    if not 0 <= sec < 1 << 31:
        raise ArgumentError(
            f"{sec} s since 1970 are no time of a bag; give t_us of stage.csv and on_edge_us of "
            "laser.yaml in the sensor's time, microseconds"
        )
    return {"sec": sec, "nanosec": nanosec}
