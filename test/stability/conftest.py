"""What the hard cases share: a bound that is asserted and recorded in one go."""

from collections.abc import Callable

import pytest

Measured = Callable[[str, float, float], None]


@pytest.fixture
def measured(request: pytest.FixtureRequest) -> Measured:
    """Assert ``error <= limit`` and keep both for the table of ``benchmark/stability.py``."""

    def check(what: str, error: float, limit: float) -> None:
        request.node.user_properties.append(("measured", (what, float(error), float(limit))))
        assert error <= limit, f"{what}: {error:.3g} exceeds {limit:.3g}"

    return check
