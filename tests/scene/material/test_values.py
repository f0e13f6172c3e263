"""Values per object, per triangle and from textures."""

import math

import pytest
import torch
import torch.nn.functional as functional

from invertwin.errors import InputError
from invertwin.scene import (
    Dielectric,
    Layer,
    Mesh,
    Multilayer,
    Object,
    PerfectConductor,
    RefractingBody,
    RoughDielectric,
    Scene,
    Slab,
    Texture,
    plate,
)

FREQUENCY = 77e9
WALL = plate(1.0, 1.0)  # two triangles


def image(rows=3, columns=4):
    generator = torch.Generator().manual_seed(2)
    return 2 + torch.rand(rows, columns, generator=generator, dtype=torch.float64)


def corners(count=20):
    generator = torch.Generator().manual_seed(3)
    return torch.rand(count, 3, 2, generator=generator, dtype=torch.float64) * 1.4 - 0.2


def test_texture_is_read_at_the_middle_of_each_triangle():
    pixels, uv = image(), corners()
    u, v = uv.mean(1).unbind(-1)
    where = torch.stack([2 * u - 1, 1 - 2 * v], dim=-1)[None, None]
    expected = functional.grid_sample(
        pixels[None, None], where, padding_mode="border", align_corners=False
    )
    assert torch.allclose(Texture(pixels, uv).values, expected.flatten(), atol=1e-12)


def test_texture_has_its_first_row_at_the_top():
    pixels = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64)
    top_right = torch.tensor([0.99, 0.99], dtype=torch.float64).expand(1, 3, 2)
    assert Texture(pixels, top_right).values.tolist() == [2.0]


def test_coordinates_per_vertex_are_those_of_the_corners():
    uv = torch.rand(4, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    by_vertex = Texture(image(), uv, WALL.faces)
    assert torch.equal(by_vertex.values, Texture(image(), uv[WALL.faces]).values)


def test_texture_laid_over_a_plate():
    pixels = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64)
    wall = plate(3.0, 2.0, divisions=2)
    texture = Texture.from_projection(pixels, wall)
    middles = wall.vertices[wall.faces].mean(1)
    for place, value in zip(middles, texture.values, strict=True):
        # +y is on the left of who looks along x.
        column, row = int(place[1] < 0), int(place[2] < 0)
        assert abs(float(value) - float(pixels[row, column])) < 1  # bilinear, nearest wins
    flat = Mesh(wall.vertices * torch.tensor([1.0, 1.0, 0.0]), wall.faces)
    with pytest.raises(InputError, match="width and height"):
        Texture.from_projection(pixels, flat)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1)])
def test_thin_images(shape):
    """An image of one row or column acts as one that has it twice."""
    pixels = image(*shape)
    repeats = [2 if count == 1 else 1 for count in shape]
    wide = pixels.repeat(*repeats)
    thin, full = (Texture(one, corners()).values for one in (pixels, wide))
    torch.testing.assert_close(thin, full)


def test_texture_is_differentiable_in_its_image():
    uv = corners()

    def amplitudes(pixels):
        return RoughDielectric(Texture(pixels, uv)).scattering_law(FREQUENCY).amplitude[:, ::50]

    inputs = image().requires_grad_()
    assert torch.autograd.gradcheck(amplitudes, inputs, check_forward_ad=True)


@pytest.mark.parametrize(
    "make",
    [
        lambda row: RoughDielectric(row, lobe_width=0.1 * row),
        lambda row: Dielectric(3.0, scattering=row / 4, rms_slope=row / 4),
        lambda row: RefractingBody(row, row),
        lambda row: Slab(3.0, row, thickness=1e-3 * row),
        lambda row: Multilayer([Layer(row, thickness=1e-3), Layer(2.0, thickness=1e-3)]),
        lambda row: PerfectConductor(row),
    ],
)
def test_values_per_triangle_are_those_of_single_objects(make):
    values = [1.5, 2.5, 3.0]
    together = make(torch.tensor(values, dtype=torch.float64))
    assert together.faces == 3
    surface = together.scattering_law(FREQUENCY)
    for k, value in enumerate(values):
        single = make(torch.tensor(value, dtype=torch.float64))
        assert single.faces is None
        for name, table in vars(single.scattering_law(FREQUENCY)).items():
            row = getattr(surface, name)
            assert row.shape == (3, *table.shape), name
            assert torch.allclose(row[k], table, rtol=1e-12, atol=1e-14), name


def test_gradients_per_triangle():
    def tables(permittivity, conductivity, thickness):
        surface = Slab(permittivity, conductivity, thickness=thickness).scattering_law(FREQUENCY)
        return surface.amplitude[:, 3::50], surface.transmittance[:, 3::50]

    rows = ([2.5, 4.0], [0.1, 0.5], [1.1e-3, 2.3e-3])
    inputs = [torch.tensor(row, dtype=torch.float64, requires_grad=True) for row in rows]
    assert torch.autograd.gradcheck(tables, inputs, eps=1e-8, atol=1e-4, rtol=1e-4)


def test_lists_become_tensors():
    material = RoughDielectric([2.0, 3.0])
    assert isinstance(material.permittivity, torch.Tensor)
    assert torch.equal(material.permittivity, torch.tensor([2.0, 3.0], dtype=torch.float64))
    scene = Scene({"wall": Object(WALL, material)})
    rows = [RoughDielectric(value).scattering_law(FREQUENCY).amplitude for value in (2.0, 3.0)]
    amplitude = scene["wall"].material.scattering_law(FREQUENCY).amplitude
    torch.testing.assert_close(amplitude, torch.stack(rows))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Object(WALL, RoughDielectric([2.0] * 3)), "mesh's 2 triangles, got 3"),
        (
            lambda: Object(WALL, Slab(2.0, thickness=Texture(image(), corners(7)))),
            "mesh's 2 triangles, got 7",
        ),
        (
            lambda: RoughDielectric([2.0, 3.0], diffuse=[0.1] * 3),
            "got permittivity for 2, diffuse for 3",
        ),
        (
            lambda: Multilayer([Layer([2.0, 3.0], thickness=1.0)], scattering=[0.1] * 3),
            r"scattering for 3, layers\[0\].permittivity for 2",
        ),
        (lambda: RoughDielectric([2.0, 0.5]), r"relative permittivity in \[1, 1e\+15\], got 0.5"),
        (lambda: RoughDielectric([2.0, math.nan]), "finite relative permittivity"),
        (lambda: RoughDielectric([]), "of some triangles, got none"),
        (lambda: RoughDielectric("concrete"), "got str"),
        (lambda: RoughDielectric(Texture(image() - 2, corners())), "relative permittivity"),
        (lambda: Texture(torch.ones(3), corners()), "image of a texture"),
        (lambda: Texture(torch.ones(0, 2), corners()), "with pixels"),
        (lambda: Texture(image(), torch.ones(4, 2)), "uv of a texture"),
        (lambda: Texture(image(), torch.ones(3, 2), WALL.faces), "indices"),
    ],
)
def test_bad_values_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
