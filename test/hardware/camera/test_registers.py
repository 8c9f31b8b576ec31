"""Sequences as data: order, waits, masks."""

from __future__ import annotations

import pytest
from camera_register_file import RegisterFile

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.hardware.camera.registers import (
    await_bits,
    parse_sequence,
    run_sequence,
)


def test_sequence_runs_left_to_right_with_waits() -> None:
    registers = RegisterFile({0x9008: 0x644})
    slept: list[float] = []
    steps = parse_sequence("1C=1 /0.5s/ 9008[1]=1 /200us/ 400004=0 /1ms/")
    run_sequence(registers, steps, slept.append)
    assert registers.writes == [(0x1C, 1), (0x9008, 0x645), (0x400004, 0)]
    assert slept == pytest.approx([0.5, 200e-6, 1e-3])


def test_mask_replaces_only_its_bits() -> None:
    registers = RegisterFile({0x4: 0xF000_5442})
    run_sequence(registers, parse_sequence("4[400]=0"), lambda _s: None)
    assert registers.values[0x4] == 0xF000_5042


@pytest.mark.parametrize("text", ["1C:1", "1C=", "G0=1", "/3min/", "1c=1"])
def test_misspelt_sequence_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="no register access"):
        parse_sequence(text)


def test_waiting_for_a_bit_that_never_comes_names_it() -> None:
    with pytest.raises(DeviceError, match=r"the filter is not ready \(register C0C4"):
        await_bits(RegisterFile(), 0xC0C4, 4, 3, "the filter")
