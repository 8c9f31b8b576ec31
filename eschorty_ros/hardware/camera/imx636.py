"""Register sequences of the IMX636 on an EVK4, as data.

Source: openeb 5.1.1, ``imx636_evk3_issd.h`` (Apache-2.0), which openeb runs on the EVK4 too;
neuromorphic-rs agrees value for value. Unconfirmed on hardware by this project.
"""

from __future__ import annotations

from eschorty_ros.hardware.camera.registers import Registers, parse_sequence

WIDTH = 1280
HEIGHT = 720

CHIP_ID = 0x0014
CHIP_ID_IMX636 = 0xA0401806
CHIP_VARIANT = 0xF128
TIME_BASE = 0x9008
TIME_BASE_ENABLED = 1

INIT = parse_sequence("""
    1C=1 /1s/ 400004=1 /0.5s/ 400004=0 /1s/
    B000=158 /300us/ B044=0 B004=A B040=0 B0C8=0 B040=0 B040=0 0=4F006442 0=F006442 B8=400 B8=400
    B07C=0 B074=2 B078=A0 C0=110 C0=210 B120=1 E120=0 B068=4 B07C=1 /10us/ B07C=3 /1ms/
    B8=401 B8=409 0=4F006442 0=4F00644A B080=77 B084=F B088=37 B08C=37 B090=DF B094=57 B098=37
    B09C=67 B0A0=37 B0A4=2F B0AC=28 B0CC=1
    B000=2F8 B004=8A B01C=30 B020=2000 B02C=FF B030=3E80 B028=FA0
    A000=B0501 /200us/ A008=2405 /200us/ A004=B0501 /200us/ A020=150 /200us/
    B040=7 B064=6 B040=F /100us/ B004=8A /200us/ B0C8=3 /200us/ B044=1 B000=2F9
    7008=1 7000=70001 8000=1E085 9008=644 4=F0005042 18=200 1014=11A1504D 9004=0 /1ms/ 9000=200
""")
"""Reset, clocks and PHY, packets, regulators, format and time base: 67 writes, 2.5 s of waits."""

START = parse_sequence("B000=2F9 9028=0 9008[1]=1 2C=22C724 4[400]=400")
"""MIPI, output, time base (restarts sensor time), pixels."""

STOP = parse_sequence("4[400]=0 2C=22C324 9028=2 /1ms/ 9008[1]=0 B000=2F8 /300us/")
"""The inverse of :data:`START`."""

DESTROY = parse_sequence("""
    70=400008 6C=EE47114 /500us/ A00C=20400 /500us/ A010=8068 /200us/ 1104=0 /200us/ A020=50 /200us/
    A004=B0500 /200us/ A008=2404 /200us/ A000=B0500
    B044=0 B004=A B040=E B0C8=0 B040=6 B040=4 0=4F006442 0=F006442 B8=401 B8=400 B07C=0
""")
"""Power the analog and the digital part down."""


def is_imx636(registers: Registers) -> bool:
    """Return whether the sensor identifies itself as an IMX636."""
    return registers.read(CHIP_ID) == CHIP_ID_IMX636 and registers.read(CHIP_VARIANT) & 3 == 0


def is_streaming(registers: Registers) -> bool:
    """Return whether the time base runs; it stops at a reset or power cycle."""
    return bool(registers.read(TIME_BASE) & TIME_BASE_ENABLED)
