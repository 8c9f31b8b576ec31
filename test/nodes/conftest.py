"""What the tests of the nodes share."""

import pytest


@pytest.fixture
def observer():
    from ros_process import Observer

    with Observer() as made:
        yield made
