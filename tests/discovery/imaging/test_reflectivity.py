"""Responses of points, and the image that explains maps."""

import pytest
import torch

import invertwin as iw
from invertwin.channel import Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.discovery.imaging.likelihood import estimate_background
from invertwin.discovery.imaging.reflectivity import (
    compute_response,
    reconstruct_reflectivity,
    thin_map,
)
from invertwin.errors import InputError
from invertwin.radar import beat_signal
from invertwin.scene import Cosine, linear_array

CHIRP = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=50e-6, samples=64)


def radar() -> iw.Radar:
    """Six places about the middle, looking at it."""
    turns = torch.arange(6, dtype=torch.float64) * (torch.pi / 3)
    out = torch.stack([turns.sin(), turns.cos(), 0 * turns], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(out)
    axes = torch.stack([-out, torch.linalg.cross(up, -out), up], dim=-1)
    half = CHIRP.wavelength / 2
    patch = Cosine(1.0)
    sender, receivers = linear_array(1, half, pattern=patch), linear_array(8, half, pattern=patch)
    return iw.Radar(sender, receivers, CHIRP, 2.0 * out, axes)


def echo(device: iw.Radar, place: torch.Tensor, section: float) -> torch.Tensor:
    """The map of one point of a radar cross-section, by the radar equation."""
    link = device.link()
    way = place - link.tx
    length = way.norm(dim=1)
    seen = torch.einsum("fc,fcd->fd", way / length[:, None], link.rotations)
    gain = link.tx_pattern.gain(seen) * link.rx_pattern.gain(seen)
    power = gain * CHIRP.wavelength**2 * section / ((4 * torch.pi) ** 3 * length**4)
    count = len(length)
    paths = Paths(
        frame=torch.arange(count),
        delay=2 * length / SPEED_OF_LIGHT,
        coefficient=power.sqrt().to(torch.complex128),
        power=torch.zeros(count, dtype=torch.float64),
        first=place.expand(count, 3),
        last=place.expand(count, 3),
        kind="coherent",
        boundary=torch.zeros(count, dtype=torch.bool),
    )
    return iw.Capture.from_beat(beat_signal(paths, device), device).spectrum(device.grid(0.8, 3.5))


def test_a_point_answers_as_the_radar_equation_says():
    device = radar()
    grid = device.grid(0.8, 3.5)
    place = torch.tensor([[-0.13, 0.21, 0.0]], dtype=torch.float64)
    found = compute_response(device, grid, place).predict_maps(
        torch.tensor([0.5], dtype=torch.float64)
    )
    true = echo(device, place[0], 0.5)
    near = found > 0.05 * found.amax((1, 2, 3), keepdim=True)
    assert int(near.sum()) > 50
    # The table has 32 entries a bin, and elements of the array are not at one place.
    assert ((found - true)[near].abs() / true.amax()).max() < 0.02


def test_two_points_closer_than_a_beam_are_two_in_the_image():
    device = radar()
    grid = device.grid(0.8, 3.5)
    line = torch.arange(-0.5, 0.51, 0.05, dtype=torch.float64)
    flat = torch.cartesian_prod(line, line)
    places = torch.cat([flat, 0 * flat[:, :1]], dim=1)
    at = torch.tensor([[0.0, -0.1, 0.0], [0.1, 0.2, 0.0]], dtype=torch.float64)
    power = echo(device, at[0], 1.0) + echo(device, at[1], 0.3)
    power = power + 1e-6 * power.max()
    some, coarse = thin_map(power, device, grid)
    assert some.shape == (device.frame_count, *coarse.shape)
    assert some[0].numel() < power[0].numel() / 4
    rest = estimate_background(some)[:, None, None].expand_as(some)
    image = reconstruct_reflectivity(compute_response(device, coarse, places), some, rest)
    assert float(image.min()) >= 0.0
    for place, section in ((at[0], 1.0), (at[1], 0.3)):
        near = (places - place).norm(dim=1) < 0.08
        assert float(image[near].sum()) == pytest.approx(section, rel=0.3)
    far = ((places[:, None] - at).norm(dim=2) > 0.12).all(1)
    assert float(image[far].sum()) < 0.1 * float(image.sum())


def test_too_many_places_are_refused():
    device = radar()
    places = torch.zeros(3_000_000, 3, dtype=torch.float64)
    with pytest.raises(InputError, match="smaller region"):
        compute_response(device, device.grid(0.8, 3.5), places)
