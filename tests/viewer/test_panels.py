"""Maps in the panel: bins stand where the axes say, the cursor is on its bin."""

import base64
import io
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from invertwin.viewer.panels import MEASURED, RESIDUAL, SIMULATED, MapPanels

RANGES = np.linspace(1.0, 4.9, 40).tolist()
ACROSS = np.linspace(-0.5, 0.5, 21).tolist()


class Gui:
    """A panel that notes what is put into it."""

    def add_html(self, content: str, *, visible: bool) -> Any:
        return SimpleNamespace(content=content, visible=visible)


def panels(*names: str) -> MapPanels:
    made = MapPanels(Gui(), names)
    made.draw_axes(RANGES, ACROSS)
    return made


def pixels(made: MapPanels, name: str) -> np.ndarray:
    """The part of a figure that bins fill, the nearest range first and the least u first."""
    data = made._images[name].content.split("base64,")[1].split('"')[0]
    whole = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), int)
    _, rows, columns = made._axes[name]
    return whole[rows, columns][::-1, ::-1]


def test_a_bright_bin_is_at_its_share_of_the_axes():
    power = np.full((40, 21), 1e-9, np.float32)
    power[30, 4] = 1.0
    made = panels(MEASURED)
    made.show({MEASURED: power}, None)
    found = pixels(made, MEASURED)
    bright = np.argwhere(found[..., 0] > 200)  # the yellow end of viridis
    middle = (bright.mean(0) + 0.5) / found.shape[:2]
    assert middle == pytest.approx([30.5 / 40, 4.5 / 21], abs=0.004)
    assert len(bright) / (found.shape[0] * found.shape[1]) == pytest.approx(1 / 840, rel=0.15)


def test_the_cursor_crosses_in_its_bin_in_all_maps():
    power = np.ones((40, 21), np.float32)
    made = panels(MEASURED, SIMULATED, RESIDUAL)
    made.show({MEASURED: power, SIMULATED: power}, (10, 15))
    for name in (MEASURED, SIMULATED, RESIDUAL):
        found = pixels(made, name)
        red = (found == (255, 60, 60)).all(-1)
        row, column = np.flatnonzero(red.all(1)), np.flatnonzero(red.all(0))
        assert (row.mean() + 0.5) / len(found) == pytest.approx(10.5 / 40, abs=0.006)
        assert (column.mean() + 0.5) / found.shape[1] == pytest.approx(15.5 / 21, abs=0.006)


def test_the_residual_needs_both_maps_and_is_white_where_they_agree():
    power = np.random.default_rng(1).random((40, 21)).astype(np.float32)
    made = panels(MEASURED, SIMULATED, RESIDUAL)
    made.show({SIMULATED: power}, None)
    assert [made._images[name].visible for name in (MEASURED, SIMULATED, RESIDUAL)] == [
        False,
        True,
        False,
    ]
    made.show({MEASURED: power, SIMULATED: 3 * power}, None)
    assert made._images[RESIDUAL].visible
    assert pixels(made, RESIDUAL).min() > 240


def test_what_has_not_changed_is_not_sent_again():
    power = np.random.default_rng(1).random((40, 21)).astype(np.float32)
    made = panels(MEASURED)
    made.show({MEASURED: power}, None)
    before = made._images[MEASURED].content
    made._images[MEASURED].content = "as it was"
    made.show({MEASURED: power.copy()}, None)
    assert made._images[MEASURED].content == "as it was"
    made.show({MEASURED: power}, (1, 1))
    assert made._images[MEASURED].content not in ("as it was", before)
