"""The method of moments in the plane: flash of a strip, peak of a dihedral."""

import math

import numpy as np
import pytest
import torch

from invertwin.channel import DihedralSection
from invertwin_studies.dihedral_moments import (
    DihedralByMoments,
    strip_section_te,
    strip_section_tm,
)

WAVELENGTH = 0.01
BAND = torch.tensor([299_792_458.0 / WAVELENGTH], dtype=torch.float64)
AHEAD = torch.tensor([[-1.0, 0.0, 0.0]], dtype=torch.float64)


@pytest.mark.parametrize("solve", [strip_section_tm, strip_section_te])
def test_a_wide_strip_has_the_flash_of_physical_optics(solve):
    line = np.linspace(-0.5, 0.5, 241)[:, None] * [10 * WAVELENGTH, 0.0]
    k = 2 * math.pi / WAVELENGTH
    found = solve(line, k, np.array([[0.0, 1.0]]))
    assert 10 * math.log10(found[0] / (k * (10 * WAVELENGTH) ** 2)) == pytest.approx(0, abs=0.3)


def test_moments_of_a_dihedral_peak_like_two_bounces():
    for polarisation in ("V", "H"):
        found = DihedralByMoments(0.1, polarisation).section(BAND, AHEAD)
        peak = DihedralSection(0.1).section(BAND, AHEAD)
        assert abs(10 * math.log10(float(found / peak))) < 1  # its free edges make the rest
