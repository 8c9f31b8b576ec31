"""What the tests of the camera's driver share."""

import pytest
from evk4_bench import CameraBench


@pytest.fixture
def bench():
    """A camera that streams."""
    with CameraBench() as made:
        yield made.streaming()
