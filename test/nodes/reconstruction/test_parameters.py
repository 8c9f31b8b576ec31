"""Parameters of the reconstruction node."""

import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.nodes.reconstruction.parameters import check_recording


@pytest.mark.parametrize("name", ["../up", "/elsewhere", "a/b", ".hidden", "two\nlines"])
def test_a_recording_stays_in_its_folder(name):
    with pytest.raises(ArgumentError, match="record_name is"):
        check_recording({"record": "", "record_name": name})
    check_recording({"record": "", "record_name": ""})
    check_recording({"record": "~", "record_name": "monday 1"})


def test_a_home_folder_that_is_not_there_is_refused():
    with pytest.raises(ArgumentError, match="record is '~nobody_here/scans'; there is no such"):
        check_recording({"record": "~nobody_here/scans", "record_name": ""})
