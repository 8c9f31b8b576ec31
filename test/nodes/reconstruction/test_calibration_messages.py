"""Goals of a calibration: what cannot be is named as in the goal, in its units."""

import math

import pytest
from eschorty_ros.action import Calibrate
from eschorty_ros.msg import CalibrationTarget

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.nodes.reconstruction.calibration_messages import request_from_goal


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"range": -1.0}, r"^range is -1\.0; choose a positive number"),
        ({"range": 1.0, "label": "post 3", "size": -0.01}, r"^target post 3: size is -0\.01; "),
        ({"range": 1.0, "range_sigma": -0.01}, r"^range_sigma is -0\.01; "),
        ({"range": 1.0, "size": math.inf}, r"^size is inf; "),
    ],
)
def test_a_target_that_cannot_be_is_named_as_in_the_goal(values, words):
    with pytest.raises(ArgumentError, match=words):
        request_from_goal(Calibrate.Goal(targets=[CalibrationTarget(**values)]))
