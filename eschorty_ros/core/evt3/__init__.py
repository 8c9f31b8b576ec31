"""EVT3, the camera's wire format: bytes to events and back, and the activity filter."""

from eschorty_ros.core.evt3._decode import EventArrays
from eschorty_ros.core.evt3.activity_filter import ActivityFilter
from eschorty_ros.core.evt3.decoder import Decoder, Encoder, Events, Triggers, sort_readout
from eschorty_ros.core.evt3.word_count import WordCounter

__all__ = [
    "ActivityFilter",
    "Decoder",
    "Encoder",
    "EventArrays",
    "Events",
    "Triggers",
    "WordCounter",
    "sort_readout",
]
