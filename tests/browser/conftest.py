"""Screenshots and figures of the browser."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser.references import PICTURES


@pytest.fixture(scope="session")
def pictures() -> Path:
    """Where screenshots and measured figures go."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    return PICTURES


@pytest.fixture(scope="session")
def note(pictures: Path) -> Callable[..., None]:
    """Keeps measured figures."""

    def keep(**figures: float) -> None:
        file = pictures / "figures.json"
        known = json.loads(file.read_text()) if file.exists() else {}
        file.write_text(json.dumps(known | figures, indent=2) + "\n")

    return keep


@pytest.fixture
def blue() -> Callable[[bytes], float]:
    """The column of the middle of what has the colour of a twin, in a screenshot."""

    def middle(png: bytes) -> float:
        shown = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), float)
        mask = (shown[..., 2] - shown[..., 0] > 40) & (shown[..., 2] - shown[..., 1] > 15)
        return float(np.median(np.nonzero(mask)[1]))

    return middle
