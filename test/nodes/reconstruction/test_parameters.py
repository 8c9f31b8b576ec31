"""Parameters of the reconstruction node."""

import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.nodes.reconstruction.parameters import check_record_name


@pytest.mark.parametrize("name", ["../up", "/elsewhere", "a/b", ".hidden", "two\nlines"])
def test_a_recording_stays_in_its_folder(name):
    with pytest.raises(ArgumentError, match="record_name is"):
        check_record_name(name)
    check_record_name("")
    check_record_name("monday 1")
