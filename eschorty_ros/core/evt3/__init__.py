"""EVT3, the camera's wire format: bytes to events and back, and the activity filter.

Time is int64 microseconds of the sensor's clock, first 24-bit wrap = 0.
"""

from eschorty_ros.core.evt3.activity_filter import ActivityFilter
from eschorty_ros.core.evt3.counters import Counters
from eschorty_ros.core.evt3.decoder import Decoder
from eschorty_ros.core.evt3.encoder import Encoder, sort_readout
from eschorty_ros.core.evt3.events import EVENT_DTYPE, EventArrays, Events, Triggers
from eschorty_ros.core.evt3.time_span import (
    WRAP_US,
    BeginTime,
    begin_time,
    first_time_high_us,
    time_span_us,
)

__all__ = [
    "EVENT_DTYPE",
    "WRAP_US",
    "ActivityFilter",
    "BeginTime",
    "Counters",
    "Decoder",
    "Encoder",
    "EventArrays",
    "Events",
    "Triggers",
    "begin_time",
    "first_time_high_us",
    "sort_readout",
    "time_span_us",
]
