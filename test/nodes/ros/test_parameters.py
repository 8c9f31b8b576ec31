"""Values of parameters as ROS reads them: whole numbers of floats, on and off as truth values."""

import contextlib

import pytest
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_process import free_domain

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.reconstruction import Settings
from eschorty_ros.nodes.ros.parameters import Parameters, from_settings


@contextlib.contextmanager
def declared(**given):
    """A node with the settings of a reconstruction, of which some are given at start."""
    context = Context()
    context.init(domain_id=free_domain())
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    node = Node("given", context=context, parameter_overrides=overrides)
    try:
        yield node, Parameters(node, from_settings(Settings, dynamic=True))
    finally:
        node.destroy_node()
        context.try_shutdown()


def test_values_of_other_types_stand_for_those_of_the_parameter():
    with declared(organized=True, detail=False, sigma_floor_px=1) as (node, parameters):
        found = [parameters[name] for name in ("organized", "detail", "sigma_floor_px")]
        assert found == ["on", "off", 1.0]
        assert Settings(**dict(parameters)).organized == "on"
        (result,) = node.set_parameters([Parameter("organized", value=False)])
        assert (result.successful, parameters["organized"]) == (True, "off")


@pytest.mark.parametrize(("name", "value"), [("detail", True), ("keep", 3)])
def test_values_that_stand_for_none_are_one_line(name, value):
    with (
        pytest.raises(ArgumentError, match=f"parameter {name} is {value}; "),
        declared(**{name: value}),
    ):
        pass


@pytest.mark.parametrize(
    ("policy", "value", "words"),
    [
        ("reliability", "foo", "choose one of .*best_effort"),
        ("history", True, "keep_last"),
        ("depth", "deep", "type int"),
        ("depth", 0, "range is 1 to"),
    ],
)
def test_a_quality_of_service_that_no_topic_can_have_is_one_line(policy, value, words):
    name = f"qos_overrides./camera/events.publisher.{policy}"
    with (
        pytest.raises(ArgumentError, match=f"parameter {name} is .*{words}"),
        declared(**{name: value}),
    ):
        pass


def test_a_quality_of_service_may_be_written_in_capitals():
    with declared(**{"qos_overrides./camera/events.publisher.reliability": "RELIABLE"}):
        pass
