"""Parameters of the reconstruction node."""

import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.nodes.reconstruction.parameters import check_recording, modulation_override


@pytest.mark.parametrize("name", ["../up", "/elsewhere", "a/b", ".hidden", "two\nlines"])
def test_a_recording_stays_in_its_folder(name):
    with pytest.raises(ArgumentError, match="record_name is"):
        check_recording({"record": "", "record_name": name})
    check_recording({"record": "", "record_name": ""})
    check_recording({"record": "~", "record_name": "monday 1"})


def test_a_home_folder_that_is_not_there_is_refused():
    with pytest.raises(ArgumentError, match="record is '~nobody_here/scans'; there is no such"):
        check_recording({"record": "~nobody_here/scans", "record_name": ""})


def test_a_frequency_below_the_least_is_named_as_the_parameter():
    with pytest.raises(ArgumentError, match=r"^frequency is 5 Hz; choose 16 to"):
        modulation_override({"frequency": 5.0, "duty": 0.5, "waveform": "square"})
