"""Registers in a dictionary, for tests of the sensor's facilities."""

from __future__ import annotations

from collections.abc import Mapping


class RegisterFile:
    """Stores written values; ``always_set`` bits read as 1, writes are recorded in order."""

    def __init__(self, values: Mapping[int, int] | None = None) -> None:
        self.values = dict(values or {})
        self.always_set: dict[int, int] = {}
        self.writes: list[tuple[int, int]] = []

    def read(self, address: int) -> int:
        return self.values.get(address, 0) | self.always_set.get(address, 0)

    def write(self, address: int, value: int) -> None:
        assert 0 <= value <= 0xFFFF_FFFF
        self.values[address] = value
        self.writes.append((address, value))
