"""Figures of images."""

import pytest
import torch

from invertwin import plotting
from invertwin.errors import InputError


def test_images_are_grey_and_derivatives_share_a_symmetric_scale():
    image = torch.linspace(0, 1, 12).reshape(3, 4)
    rates = {"full": image - 0.25, "fixed outlines": 0.0 * image}
    figure = plotting.images({"mask": image}, rates, "∂ mask [1/m]")
    shown = [axes.images[0] for axes in figure.axes if axes.images]
    assert [axes.get_title() for axes in figure.axes][:3] == ["mask", "full", "fixed outlines"]
    assert shown[0].get_cmap().name == "gray"
    low, high = shown[1].get_clim()
    assert low == -high == shown[2].get_clim()[0]
    assert 0.7 < high <= 0.75


def test_no_image_is_refused():
    with pytest.raises(InputError, match="at least one image"):
        plotting.images({})
