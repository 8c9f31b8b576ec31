"""Choices, limits and defaults that the command line writes out are those of the package."""

import click
import pytest

from eschorty_ros.cli import main
from eschorty_ros.core.calibration import METHODS, SIGMA_ROW_PX
from eschorty_ros.core.calibration.targets_file import SIGMA_RANGE_MM
from eschorty_ros.core.modulation import FREQUENCY_MAX_HZ, FREQUENCY_MIN_HZ
from eschorty_ros.core.reconstruction.settings import KEEP
from eschorty_ros.live.bag_files import STORAGES
from eschorty_ros.viewer.page import HOST, PORT


def option(command: str, name: str) -> click.Option:
    found = main.get_command(click.Context(main), command)
    return next(param for param in found.params if f"--{name}" in param.opts)


@pytest.mark.parametrize(
    ("command", "name", "choices"),
    [("convert", "storage", STORAGES), ("scan", "keep", KEEP), ("calibrate", "method", METHODS)],
)
def test_choices_are_those_of_the_package(command, name, choices):
    assert set(option(command, name).type.choices) == set(choices)


@pytest.mark.parametrize("command", ["scan", "simulate", "reconstruct", "convert"])
def test_frequencies_are_those_of_the_modulation(command):
    accepted = option(command, "frequency").type
    assert (accepted.min, accepted.max) == (FREQUENCY_MIN_HZ, FREQUENCY_MAX_HZ)


@pytest.mark.parametrize(
    ("command", "name", "default"),
    [
        ("scan", "host", HOST),
        ("scan", "port", PORT),
        ("calibrate", "row-sigma", SIGMA_ROW_PX),
        ("calibrate", "range-sigma", SIGMA_RANGE_MM),
    ],
)
def test_defaults_are_those_of_the_package(command, name, default):
    assert option(command, name).default == default
