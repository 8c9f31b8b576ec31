"""EVT3, the event camera's wire format: streaming decoder and encoder.

Time is int64 microseconds of the sensor's clock, first 24-bit wrap = 0.
"""

from eschorty_ros.core.evt3._decode import (
    EVENT_DTYPE,
    Counters,
    Decoder,
    Events,
    Triggers,
    event_arrays,
)
from eschorty_ros.core.evt3.encoder import Encoder, sort_readout

__all__ = [
    "EVENT_DTYPE",
    "Counters",
    "Decoder",
    "Encoder",
    "Events",
    "Triggers",
    "event_arrays",
    "sort_readout",
]
