"""Bad input as users meet it."""

from collections.abc import Iterator

import pytest
from jaxtyping import config


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Without the run-time shape checks of the tests, which would catch bad input first."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)
