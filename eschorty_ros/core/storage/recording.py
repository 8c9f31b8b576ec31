"""A recording: a folder with the camera's bytes and what is needed to turn them into points.

``events.raw``, ``stage.csv``, ``laser.yaml``, ``calibration.yaml`` and, when simulated,
``truth.csv``. That of a scan of the nodes also has ``scan.yaml``, ``settings.yaml`` and
``marks.csv``.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import as_array, integer_vector
from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.base.files import atomic_write, open_regular_file
from eschorty_ros.core.base.numbers import file_path, short
from eschorty_ros.core.base.schema import Schema, Within, validate
from eschorty_ros.core.base.yaml_file import read_yaml, write_yaml
from eschorty_ros.core.clocks import (
    NM_PER_MM,
    POSITION_LIMIT_MM,
    SPEED_LIMIT_MM_S,
    StageTrack,
    quantise_nm,
)
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration, load_calibration

EVENTS_FILE = "events.raw"
STAGE_FILE = "stage.csv"
LASER_FILE = "laser.yaml"
CALIBRATION_FILE = "calibration.yaml"
TRUTH_FILE = "truth.csv"
SCAN_FILE = "scan.yaml"
SETTINGS_FILE = "settings.yaml"
MARKS_FILE = "marks.csv"
BAG_FILE = "metadata.yaml"
"""A rosbag2 has it, and a recording does not."""
RAW_ALONE = (
    f"a .raw alone goes into a folder as {EVENTS_FILE}, beside {LASER_FILE}, {STAGE_FILE} and "
    f"{CALIBRATION_FILE} (docs/python.md)"
)
"""What to do with a file that is no recording."""

_NEEDED = {
    EVENTS_FILE: "",
    STAGE_FILE: "",
    LASER_FILE: " (or reconstruct --frequency)",
    CALIBRATION_FILE: " (or reconstruct --calibration)",
}
"""The files that a recording needs, and what stands in for one."""

STAGE_DTYPE = np.dtype([("t_us", "<i8"), ("position_mm", "<f8")])
TRUTH_DTYPE = np.dtype([("t_us", "<i8"), ("column", "<u2"), ("range_mm", "<f8")])
"""One row per modulation period and lit column: the time is the middle of the lit phase."""

MARK_DTYPE = np.dtype([("byte", "<i8"), ("packets_lost", "<i8"), ("laser_on", "<i8")])
"""Before the word at ``byte`` packets are missing, or the laser was switched on (``laser_on``)."""

_LINES_AT_ONCE = 65_536
_HALF_NM_MM = 0.5e-6


@dataclass(frozen=True, kw_only=True)
class _LaserFile(Schema):
    KIND = LASER_FILE
    frequency_hz: float
    duty: float
    waveform: str
    on_edge_us: int | None = None


def between(stage_mm: NDArray[np.float64], start_mm: float, stop_mm: float) -> NDArray[np.bool_]:
    """Return a mask of the stage positions between start and stop, both included."""
    low_mm, high_mm = sorted((start_mm, stop_mm))
    return (stage_mm >= low_mm - _HALF_NM_MM) & (stage_mm <= high_mm + _HALF_NM_MM)


@dataclass(frozen=True, kw_only=True)
class ScanLog(Schema):
    """The scan that a recording is of, and what the recording lacks.

    ``state`` is ``recording`` while it is written, and stays so when the process is killed.
    ``packets_lost`` did not arrive, ``packets_left_out`` arrived and were not written, for the
    ``reason``. A gap of the stage's samples longer than ``stage_gap_s`` is not bridged; 0 bridges
    any. A ``speed_mm_s`` of 0 is not known.
    """

    KIND = "log of a scan"

    scan_id: str
    start_mm: float
    stop_mm: float
    passes: Annotated[int, Within(1)] = 1
    speed_mm_s: Annotated[float, Within(0.0, SPEED_LIMIT_MM_S)] = 0.0
    stage_gap_s: Annotated[float, Within(0.0, 1e9)] = 0.0
    state: Literal["recording", "ended"] = "recording"
    packets_lost: Annotated[int, Within(0)] = 0
    packets_left_out: Annotated[int, Within(0)] = 0
    reason: str | None = None

    @property
    def faults(self) -> list[str]:
        """Return one line for each thing that the recording lacks."""
        found = []
        if self.state == "recording":
            found.append("the recording was not ended: its process was killed or still writes")
        if self.packets_lost:
            found.append(f"{self.packets_lost:,} packets of the recording were lost on the way")
        if self.packets_left_out:
            found.append(f"{self.packets_left_out:,} packets are not recorded: {self.reason}")
        elif self.reason:
            found.append(self.reason)
        return found


@dataclass(frozen=True, repr=False)
class Recording:
    """The content of a recording folder.

    Parameters
    ----------
    path : Path
        The folder.
    events_path : Path
        The camera's bytes, Prophesee RAW.
    stage : StageTrack
        Stage position over sensor time; bridges any gap, of a recorded scan those that its log
        allows.
    stage_samples : ndarray of STAGE_DTYPE, shape (n,)
        The samples of ``stage``, positions rounded to nanometres.
    modulation : Modulation
    calibration : Calibration
    scan : ScanLog or None
        ``None`` unless the nodes recorded a scan.
    settings : dict
        Settings of the reconstruction at that scan.
    marks : ndarray of MARK_DTYPE, shape (n,)
        Where bytes are missing and where the laser was switched on.
    calibration_replaced : str
        Name of the recording's own calibration, where one of another name is used.
    """

    path: Path
    events_path: Path
    stage: StageTrack
    stage_samples: NDArray[np.void]
    modulation: Modulation
    calibration: Calibration
    scan: ScanLog | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    marks: NDArray[np.void] = field(default_factory=lambda: np.empty(0, MARK_DTYPE))
    calibration_replaced: str = ""

    def __repr__(self) -> str:
        return f"Recording({str(self.path)!r}, {self.modulation}, {self.calibration.name})"

    def corrected(
        self, calibration: Calibration | None = None, frequency_hz: float | None = None
    ) -> Recording:
        """Return the recording with another calibration or frequency of the laser, if given."""
        modulation = self.modulation
        if frequency_hz is not None:
            modulation = replace(modulation, frequency_hz=frequency_hz)
        given = calibration or self.calibration
        recorded = self.calibration_replaced or self.calibration.name
        replaced = recorded if given.name != recorded else ""
        return replace(
            self, calibration=given, modulation=modulation, calibration_replaced=replaced
        )

    def earlier(self, by_us: int) -> Recording:
        """Return the recording with earlier times of the stage and of the laser's edge."""
        samples, modulation = self.stage_samples.copy(), self.modulation
        samples["t_us"] -= by_us
        if modulation.on_edge_us is not None:
            modulation = replace(modulation, on_edge_us=modulation.on_edge_us - by_us)
        track = _track(samples, self.scan)
        return replace(self, stage=track, stage_samples=samples, modulation=modulation)

    @cached_property
    def truth(self) -> NDArray[np.void] | None:
        """True ranges, TRUTH_DTYPE, read on first use; ``None`` when there are none.

        Raises ``FormatError`` when ``truth.csv`` is malformed.
        """
        file = self.path / TRUTH_FILE
        return read_truth_csv(file) if file.exists() else None


def load_recording(
    path: str | os.PathLike[str],
    calibration: Calibration | None = None,
    frequency_hz: float | None = None,
) -> Recording:
    """Read a recording folder; the events themselves stay on disk.

    ``calibration`` and ``frequency_hz`` of the laser stand in for the recording's own, which may
    then be missing.

    Raises
    ------
    FormatError, CalibrationError
        One line naming the file, the fault and the remedy.
    """
    folder = file_path("path", path)
    if not folder.exists():
        raise FormatError(f"{folder} does not exist; give a recording folder; {RAW_ALONE}")
    if not folder.is_dir():
        raise FormatError(f"{folder} is not a folder; give a recording folder; {RAW_ALONE}")
    given = {CALIBRATION_FILE: calibration, LASER_FILE: frequency_hz}
    _check_files(folder, {name for name, value in given.items() if value is not None})
    scan = read_scan_yaml(folder / SCAN_FILE) if (folder / SCAN_FILE).exists() else None
    try:
        samples = read_stage_csv(folder / STAGE_FILE)
    except FormatError as error:
        # A process that was killed at once has written no two samples.
        faults = scan.faults if scan is not None else []
        raise FormatError("; ".join((str(error), *faults))) from error
    settings, marks = folder / SETTINGS_FILE, folder / MARKS_FILE
    laser, build = folder / LASER_FILE, folder / CALIBRATION_FILE
    own = calibration if calibration and not build.is_file() else load_calibration(build)
    if frequency_hz is not None and not laser.is_file():
        modulation = Modulation(frequency_hz)
    else:
        modulation = read_laser_yaml(laser)
    recording = Recording(
        path=folder,
        events_path=folder / EVENTS_FILE,
        stage=_track(samples, scan),
        stage_samples=samples,
        modulation=modulation,
        calibration=own,
        scan=scan,
        settings=read_settings_yaml(settings) if settings.exists() else {},
        marks=read_marks_csv(marks) if marks.exists() else np.empty(0, MARK_DTYPE),
    )
    return recording.corrected(calibration, frequency_hz)


def recorded_events(folder: Path) -> Path:
    """Return the RAW file of a recording folder whose other files may be missing.

    Raises ``FormatError`` when there is none.
    """
    _check_files(folder, _NEEDED.keys() - {EVENTS_FILE})
    return folder / EVENTS_FILE


def _check_files(folder: Path, replaced: set[str]) -> None:
    """Refuse a folder that lacks files, all of them named; those ``replaced`` may be missing."""
    missing = []
    for name, instead in _NEEDED.items():
        if name not in replaced and not (folder / name).is_file():
            packed = (folder / f"{name}.gz").is_file()
            missing.append(name + (f" (run gunzip on {name}.gz)" if packed else instead))
    if missing and (folder / BAG_FILE).is_file():
        raise FormatError(f"{folder} is a bag; make a recording of it by `eschorty convert`")
    if missing:
        raise FormatError(
            f"{folder}: missing from the recording {'is' if len(missing) == 1 else 'are'} "
            f"{', '.join(missing)}; docs/python.md shows how to add them"
        )


def _track(samples: NDArray[np.void], scan: ScanLog | None) -> StageTrack:
    track = StageTrack(round(scan.stage_gap_s * 1e6) or None if scan is not None else None)
    track.append(samples["t_us"], samples["position_mm"])
    return track


def read_scan_yaml(path: str | os.PathLike[str]) -> ScanLog:
    """Read ``scan.yaml``.

    Raises ``FormatError`` in one line with the file, the key, the value and the remedy.
    """
    return validate(ScanLog, read_yaml(path, FormatError), FormatError)


def read_settings_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read ``settings.yaml``: names and values; a FormatError names the file and the fault."""
    data = read_yaml(path, FormatError).data
    if not isinstance(data, dict):
        raise FormatError(f"{path}: it has {short(data)} instead of settings; remove it")
    return data


def read_marks_csv(path: str | os.PathLike[str]) -> NDArray[np.void]:
    """Read ``marks.csv``: MARK_DTYPE, shape (n,); a FormatError names the file and the line."""
    path = file_path("path", path)
    marks = _read_csv(path, MARK_DTYPE)
    back = np.flatnonzero(np.diff(marks["byte"], prepend=0) < 0)
    if back.size:
        raise FormatError(
            f"{path} line {_line_number(path, back[0])}: byte is {marks['byte'][back[0]]}; "
            "write marks in order"
        )
    return marks


def read_laser_yaml(path: str | os.PathLike[str]) -> Modulation:
    """Read ``laser.yaml``.

    Raises ``FormatError`` in one line with the file, the key, the value and the remedy.
    """
    laser = validate(_LaserFile, read_yaml(path, FormatError), FormatError)
    try:
        return Modulation(**laser.as_dict())
    except ArgumentError as error:
        raise FormatError(f"{path}: {error}") from error


def write_laser_yaml(path: str | os.PathLike[str], modulation: Modulation) -> None:
    """Write ``laser.yaml`` at ``path``; an unknown ``on_edge_us`` is left out.

    Raises ``ArgumentError`` for what is no `Modulation`, or when the path cannot be written.
    """
    if not isinstance(modulation, Modulation):
        raise ArgumentError(f"modulation is {short(modulation)}; give a Modulation")
    known = {name: value for name, value in asdict(modulation).items() if value is not None}
    write_yaml(path, known)


def write_stage_csv(path: str | os.PathLike[str], t_us: ArrayLike, position_mm: ArrayLike) -> None:
    """Write ``stage.csv`` at ``path``, positions to the nanometre.

    Parameters
    ----------
    path : path
        The file.
    t_us : array_like of int, shape (n,)
        Unwrapped sensor time, strictly increasing.
    position_mm : array_like, shape (n,)

    Raises
    ------
    ArgumentError
        When there are fewer than two samples, the times do not increase, a position is not finite
        or the path cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_stage_csv(f"{folder}/stage.csv", [0, 10_000], [10.0, 10.5])
    ...     print(Path(f"{folder}/stage.csv").read_text())
    t_us,position_mm
    0,10.000000
    10000,10.500000
    <BLANKLINE>
    """
    samples = _columns(STAGE_DTYPE, t_us=t_us, position_mm=position_mm)
    if len(samples) < 2:
        raise ArgumentError(f"t_us and position_mm have {len(samples)} samples; give two or more")
    back = np.flatnonzero(np.diff(samples["t_us"]) <= 0)
    if back.size:
        raise ArgumentError(
            f"t_us goes from {samples['t_us'][back[0]]} to {samples['t_us'][back[0] + 1]}; "
            "give samples in time order"
        )
    _write_csv(path, samples)


def write_truth_csv(
    path: str | os.PathLike[str], t_us: ArrayLike, column: ArrayLike, range_mm: ArrayLike
) -> None:
    """Write ``truth.csv`` at ``path``: arrays of shape (n,), ranges to the nanometre.

    Raises ``ArgumentError`` when a range is not finite or the path cannot be written.
    """
    _write_csv(path, _columns(TRUTH_DTYPE, t_us=t_us, column=column, range_mm=range_mm))


def _columns(dtype: np.dtype[Any], **values: ArrayLike) -> NDArray[np.void]:
    arrays = {name: as_array(name, value) for name, value in values.items()}
    shapes = {array.shape for array in arrays.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        raise ArgumentError(
            f"{', '.join(f'{n} has shape {a.shape}' for n, a in arrays.items())}; "
            "give one-dimensional arrays of one length"
        )
    table = np.empty(next(iter(shapes)), dtype)
    for name, array in arrays.items():
        kind = dtype[name]
        if kind.kind == "f":
            table[name] = quantise_nm(array, name) / NM_PER_MM
        else:
            limits = np.iinfo(kind)
            table[name] = integer_vector(name, array, kind, limits.min, limits.max)
    return table


def _write_csv(path: str | os.PathLike[str], table: NDArray[np.void]) -> None:
    with atomic_write(path) as stream:
        stream.write(csv_header(table.dtype))
        for start in range(0, len(table), _LINES_AT_ONCE):
            stream.write(csv_lines(table[start : start + _LINES_AT_ONCE]))


def csv_header(dtype: np.dtype[Any]) -> bytes:
    """Return the first line of a table."""
    return (",".join(dtype.names or ()) + "\n").encode()


def csv_lines(table: NDArray[np.void]) -> bytes:
    """Return the lines of a table, lengths to the nanometre."""
    kinds = [table.dtype[name].kind for name in table.dtype.names or ()]
    pattern = ",".join("%.6f" if kind == "f" else "%d" for kind in kinds) + "\n"
    return "".join([pattern % row for row in table.tolist()]).encode()


def read_stage_csv(path: str | os.PathLike[str]) -> NDArray[np.void]:
    """Read ``stage.csv``: STAGE_DTYPE, shape (n,), two samples or more, in time order.

    Raises ``FormatError`` in one line with the file, the line and the remedy.
    """
    path = file_path("path", path)
    samples = _read_csv(path, STAGE_DTYPE)
    if len(samples) < 2:
        raise FormatError(
            f"{path}: stage samples: {len(samples)}; record two or more, the same position twice "
            "where the stage rests"
        )
    times = samples["t_us"]
    back = np.flatnonzero(np.diff(times) <= 0)
    if back.size:
        raise FormatError(
            f"{path} line {_line_number(path, back[0] + 1)}: t_us goes from {times[back[0]]} to "
            f"{times[back[0] + 1]}; write each time once and in order"
        )
    samples["position_mm"] = quantise_nm(samples["position_mm"]) / NM_PER_MM
    return samples


def read_truth_csv(path: str | os.PathLike[str]) -> NDArray[np.void]:
    """Read ``truth.csv``: TRUTH_DTYPE, shape (n,).

    Raises ``FormatError`` in one line with the file, the line and the remedy.
    """
    return _read_csv(file_path("path", path), TRUTH_DTYPE)


def _read_csv(path: Path, dtype: np.dtype[Any]) -> NDArray[np.void]:
    names = dtype.names or ()
    try:
        with TextIOWrapper(open_regular_file(path, FormatError), "utf-8-sig") as stream:
            header = stream.readline().strip()
            if header.replace(" ", "") != ",".join(names):
                raise FormatError(
                    f"{path} line 1: it reads {short(header)}; write {','.join(names)}"
                )
            table = _parse_table(stream, dtype)
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror or error}; check it") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: it is not text; write {','.join(names)} lines") from error
    except ValueError:
        raise FormatError(_first_fault(path, dtype)) from None
    for name in names:
        if dtype[name].kind == "f":
            _check_lengths(path, name, table[name])
    return table


def _check_lengths(path: Path, name: str, values: NDArray[np.float64]) -> None:
    wrong = np.flatnonzero(~(np.abs(values) <= POSITION_LIMIT_MM))
    if wrong.size:
        raise FormatError(
            f"{path} line {_line_number(path, wrong[0])}: {name} is {values[wrong[0]]:g}; "
            f"write a length within {POSITION_LIMIT_MM:g} mm"
        )


def _parse_table(stream: Any, dtype: np.dtype[Any]) -> NDArray[np.void]:
    with warnings.catch_warnings():
        # The caller checks for an empty table.
        warnings.filterwarnings("ignore", "loadtxt: input contained no data", UserWarning)
        return np.atleast_1d(np.loadtxt(stream, dtype, delimiter=",", comments=None))


def _line_number(path: Path, index: int) -> int:
    """Return the line of table row ``index``, blank lines counted as an editor does."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    filled = [number for number, line in enumerate(lines, 1) if line.strip()]
    return filled[index + 1]


def _first_fault(path: Path, dtype: np.dtype[Any]) -> str:
    """Return the message about the first line that does not fit."""
    names = dtype.names or ()
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1):
        cells = line.split(",")
        if number == 1 or not line.strip():
            continue
        if len(cells) != len(names):
            return (
                f"{path} line {number}: it has {len(cells)} cells; "
                f"write {len(names)}: {','.join(names)}"
            )
        for name, cell in zip(names, cells, strict=True):
            kind = "a number" if dtype[name].kind == "f" else "a whole number in range"
            if not _fits(cell, dtype[name]):
                return f"{path} line {number}: {name} is {short(cell.strip())}; write {kind}"
    return f"{path}: it is no table of {','.join(names)}; write it again"


def _fits(cell: str, kind: np.dtype[Any]) -> bool:
    try:
        if kind.kind == "f":
            float(cell)
            return True
        return bool(np.iinfo(kind).min <= int(cell) <= np.iinfo(kind).max)
    except ValueError:
        return False
