"""EVT3 words: a word is 16 bits, little-endian; its type is bits 15..12, its payload bits 11..0.

Source: Prophesee's public EVT 3.0 format description.
"""

from __future__ import annotations

ADDR_Y = 0x0
LEGACY_Y = 0x1
ADDR_X = 0x2
VECT_BASE_X = 0x3
VECT_12 = 0x4
VECT_8 = 0x5
TIME_LOW = 0x6
CONTINUED_4 = 0x7
TIME_HIGH = 0x8
EXT_TRIGGER = 0xA
OTHERS = 0xE
CONTINUED_12 = 0xF
UNUSED = (0x9, 0xB, 0xC, 0xD)

# Payloads of OTHERS.
ERC_EVENTS_IN = 0x014
ERC_EVENTS_OUT = 0x016
DROPPED_TIME_LOW = 0xED6
DROPPED_TIME_HIGH = 0xED8
DROPPED_EVENTS = 0xEDA

ADDRESSES = 2048
"""Row and column are 11 bits; bit 11 of ADDR_X and VECT_BASE_X is the polarity."""
