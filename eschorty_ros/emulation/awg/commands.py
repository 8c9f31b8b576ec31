"""The SCPI subset of a UTG900E-like generator, as the instrument parses it.

Written from the command table of the instrument's family, not from the driver's profile.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

WAVES = ("SINe", "SQUare", "PULSe", "RAMP", "ARB", "NOISe", "DC")
MODES = ("CONTinue", "AM", "PM", "FM", "FSK", "Line", "Log", "BURSt")
LEVEL_LIMIT_V = 10.0
LEAST_SPAN_V = 0.001
HIGH_Z_OHM = 10000.0
_SOURCE_OHM = 50.0


@dataclass
class ChannelState:
    """Settings of one output, as after power-up."""

    output: bool = False
    wave: str = "SINE"
    mode: str = "CONTINUE"
    burst_type: str = "NCYC"
    burst_source: str = "INTERNAL"
    burst_cycles: float = 1.0
    burst_phase_deg: float = 0.0
    frequency_hz: float = 1000.0
    high_v: float = 0.05
    low_v: float = -0.05
    duty_percent: float = 50.0
    amplitude_unit: str = "VPP"
    load_ohm: float = HIGH_Z_OHM
    inversion: bool = False
    limit: bool = False
    limit_lower_v: float = -LEVEL_LIMIT_V
    limit_upper_v: float = LEVEL_LIMIT_V

    @property
    def idle_v(self) -> float:
        """Return the level between bursts: that of the phase at which a burst starts."""
        turn = self.burst_phase_deg / 360.0 % 1.0
        if self.wave == "SINE":
            share = 0.5 + 0.5 * math.sin(2.0 * math.pi * turn)
        else:
            share = float(turn < self.duty_percent / 100.0)
        return self.low_v + share * (self.high_v - self.low_v)

    def set_load(self, load_ohm: float) -> None:
        """Set the load; the same source voltage then reads back as other volts."""
        factor = _divided(load_ohm) / _divided(self.load_ohm)
        self.high_v, self.low_v = self.high_v * factor, self.low_v * factor
        self.load_ohm = load_ohm

    def set_levels(self, high_v: float, low_v: float) -> None:
        """Set levels that are in range, in order and inside the clamp; ignore others."""
        if self.limit:
            high_v, low_v = self._clamped(high_v), self._clamped(low_v)
        bound = LEVEL_LIMIT_V * _divided(self.load_ohm)
        if high_v - low_v >= LEAST_SPAN_V - 1e-9 and max(high_v, -low_v) <= bound:
            self.high_v, self.low_v = high_v, low_v

    def _clamped(self, level_v: float) -> float:
        return min(max(level_v, self.limit_lower_v), self.limit_upper_v)


def _divided(load_ohm: float) -> float:
    return 1.0 if load_ohm >= HIGH_Z_OHM else load_ohm / (load_ohm + _SOURCE_OHM)


@dataclass(frozen=True)
class Command:
    """One setting: its path, and the functions that set it and that return its reply."""

    path: str
    put: Callable[[ChannelState, str], None]
    show: Callable[[ChannelState], str]
    pattern: re.Pattern[str]


def _command(
    path: str, put: Callable[[ChannelState, str], None], show: Callable[[ChannelState], str]
) -> Command:
    return Command(path, put, show, re.compile(":".join(map(_keyword, path.split(":"))), re.I))


def _keyword(word: str) -> str:
    """Return the pattern of a SCPI keyword: its capitals alone, or its long form."""
    short = "".join(letter for letter in word if not letter.islower())
    return f"(?:{re.escape(word)}|{re.escape(short)})"


def match_keyword(words: tuple[str, ...], text: str) -> str | None:
    """Return the long form, in capitals, of the keyword ``text``, ``None`` when it is none."""
    for word in words:
        if re.fullmatch(_keyword(word), text, re.I):
            return word.upper()
    return None


def _number(text: str, low: float, high: float) -> float | None:
    """Return a plain decimal within bounds; the instrument ignores anything else."""
    if re.fullmatch(r"[-+]?\d*\.?\d+", text) is None:
        return None
    value = float(text)
    return value if low <= value <= high else None


def _switch(path: str, name: str) -> Command:
    def put(state: ChannelState, text: str) -> None:
        if text.upper() in ("ON", "OFF", "1", "0"):
            setattr(state, name, text.upper() in ("ON", "1"))

    return _command(path, put, lambda state: "ON" if getattr(state, name) else "OFF")


def _word(path: str, name: str, words: tuple[str, ...]) -> Command:
    def put(state: ChannelState, text: str) -> None:
        found = match_keyword(words, text)
        if found is not None:
            setattr(state, name, found)

    return _command(path, put, lambda state: str(getattr(state, name)))


def _value(path: str, name: str, low: float, high: float, decimals: int) -> Command:
    def put(state: ChannelState, text: str) -> None:
        value = _number(text, low, high)
        if value is not None:
            setattr(state, name, round(value, decimals))

    return _command(path, put, lambda state: _plain(getattr(state, name), decimals))


def _level(path: str, name: str) -> Command:
    def put(state: ChannelState, text: str) -> None:
        value = _number(text, -LEVEL_LIMIT_V, LEVEL_LIMIT_V)
        if value is not None:
            levels = {"high_v": state.high_v, "low_v": state.low_v, name: round(value, 3)}
            state.set_levels(**levels)

    return _command(path, put, lambda state: _plain(getattr(state, name), 3))


def _plain(value: float, decimals: int) -> str:
    """Return a plain decimal without trailing zeros."""
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _put_frequency(state: ChannelState, text: str) -> None:
    most = {"SQUARE": 20e6, "PULSE": 20e6, "RAMP": 400e3, "ARB": 10e6}.get(state.wave, 60e6)
    value = _number(text, 1e-6, most)
    if value is not None:
        state.frequency_hz = round(value, 6)


def _put_load(state: ChannelState, text: str) -> None:
    value = _number(text, 1.0, HIGH_Z_OHM)
    if value is not None:
        state.set_load(value)


CHANNEL_COMMANDS = (
    _switch("OUTPut", "output"),
    _word("BASE:WAVe", "wave", WAVES),
    _word("MODe", "mode", MODES),
    _command("BASE:FREQuency", _put_frequency, lambda state: _plain(state.frequency_hz, 6)),
    _level("BASE:HIGH", "high_v"),
    _level("BASE:LOW", "low_v"),
    _value("BASE:DUTY", "duty_percent", 0.1, 99.9, 3),
    _word("AMPLitude:UNIT", "amplitude_unit", ("VPP", "VRMS")),
    _command("LOAD", _put_load, lambda state: _plain(state.load_ohm, 0)),
    _word("BURSt:TYPe", "burst_type", ("NCYC", "GATe", "INFinit")),
    _value("BURSt:CYCLes", "burst_cycles", 1.0, 1e6, 0),
    _value("BURSt:PHASe", "burst_phase_deg", 0.0, 360.0, 2),
    _word("TRIGger:SOURce", "burst_source", ("INTernal", "EXTernal", "MANual")),
    _switch("INVersion", "inversion"),
    _switch("LIMit:ENABle", "limit"),
    _value("LIMit:LOWer", "limit_lower_v", -LEVEL_LIMIT_V, LEVEL_LIMIT_V, 3),
    _value("LIMit:UPPer", "limit_upper_v", -LEVEL_LIMIT_V, LEVEL_LIMIT_V, 3),
)


def find_command(path: str) -> Command | None:
    """Return the command of a channel by its path, in long or short form."""
    return next((c for c in CHANNEL_COMMANDS if c.pattern.fullmatch(path)), None)
