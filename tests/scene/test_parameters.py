"""Parameters: identity at the start, composition, gradients."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.scene import (
    Compose,
    Itu,
    Layer,
    MaterialValues,
    Mesh,
    Multilayer,
    Object,
    PerfectConductor,
    Pose,
    RoughDielectric,
    Scale,
    Scene,
    Slab,
    Texture,
    Translation,
    Vertices,
    box,
    plate,
    rigid,
    rotation_angle,
    rotation_from_vector,
)
from invertwin.scene.material.values import RANGES


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def scene() -> Scene:
    # A mesh away from its own origin, so that turning about the wrong point would show.
    block = box([0.2, 0.4, 0.6])
    mesh = Mesh(block.vertices + vector(1.0, 2.0, 3.0), block.faces)
    pose = rigid(rotation_from_vector(vector(0.3, -0.2, 0.5)), vector(0.0, 0.5, 2.0))
    return Scene(
        {
            "block": Object(mesh, RoughDielectric(4.0, 0.1, 0.5, 0.3), pose),
            "wall": Object(plate(2.0, 2.0), PerfectConductor()),
        }
    )


def set_parameters(module: nn.Module, *values: Tensor) -> nn.Module:
    for parameter, value in zip(module.parameters(), values, strict=True):
        parameter.data = value
    return module


def vertices_after(module: nn.Module, *values: Tensor) -> Tensor:
    """World vertices as a function of the module's parameters, for gradcheck."""
    names = [name for name, _ in module.named_parameters()]
    moved = torch.func.functional_call(module, dict(zip(names, values, strict=True)), (scene(),))
    return moved["block"].vertices


@pytest.mark.parametrize(
    "module",
    [
        Translation("block"),
        Pose("block"),
        Scale("block"),
        Vertices("block", 8),
        Compose(),
        Compose(Pose("block"), Compose(Scale("block"), Translation("block"))),
    ],
)
def test_identity_at_the_start(module):
    before = scene()
    after = module(before)
    assert after.names == before.names
    assert torch.allclose(after["block"].vertices, before["block"].vertices, atol=1e-15)
    assert after["wall"] is before["wall"]
    assert all(p.dtype == torch.float64 for p in module.parameters())


def test_translation_moves_along_world_axes():
    moved = Translation("block", [0.1, -0.2, 0.3])(scene())
    shift = vector(0.1, -0.2, 0.3)
    assert torch.allclose(moved["block"].vertices, scene()["block"].vertices + shift)


def test_pose_turns_about_the_centre():
    before = scene()["block"]
    r = vector(0.1, 0.7, -0.4)
    after = Pose("block", translation=vector(1.0, 0.0, 0.0), rotation=r)(scene())["block"]
    assert torch.allclose(after.center, before.center + vector(1.0, 0.0, 0.0))
    turned = (before.vertices - before.center) @ rotation_from_vector(r).T
    assert torch.allclose(after.vertices - after.center, turned)


def test_rotation_numbers_are_the_rotation_vector_near_the_identity():
    module = set_parameters(Pose("block"), vector(0, 0, 0), vector(1.0, 1e-4, -2e-4, 3e-4))
    expected = rotation_from_vector(vector(1e-4, -2e-4, 3e-4))
    assert isinstance(module, Pose)
    assert float(rotation_angle(module.rotation_matrix.detach() @ expected.T)) < 1e-10


def test_rotation_can_start_from_four_numbers_and_at_any_length():
    half_turn = Pose("block", rotation=[0.0, 0.0, 5.0, 0.0]).rotation_matrix
    assert torch.allclose(half_turn, torch.diag(vector(-1.0, 1.0, -1.0)), atol=1e-15)
    same = Pose("block", rotation=[0.0, math.pi, 0.0]).rotation_matrix
    assert torch.allclose(half_turn, same, atol=1e-15)


@pytest.mark.parametrize(
    "q", [(1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0, 0.0), (0.0, 1.0, 1.0, -1.0), (0.7, 0.1, -3.0, 0.2)]
)
def test_pose_has_no_singularity(q):
    module = Pose("block")
    inputs = (vector(0.1, 0.2, 0.3).requires_grad_(), vector(*q).requires_grad_())
    assert torch.autograd.gradcheck(lambda *values: vertices_after(module, *values), inputs)
    # All three directions of turning show up in the gradient: no lock.
    jacobian = torch.autograd.functional.jacobian(
        lambda numbers: vertices_after(module, inputs[0].detach(), numbers).flatten(), vector(*q)
    )
    assert torch.linalg.matrix_rank(jacobian) == 3


def test_scale_acts_about_the_centre():
    before = scene()["block"]
    after = Scale("block", 2.0)(scene())["block"]
    assert torch.allclose(after.center, before.center)
    assert torch.allclose(after.vertices, before.center + 2 * (before.vertices - before.center))


def test_vertices_move_in_the_frame_of_the_object():
    module = Vertices("block", 8)
    module.offsets.data[3] = vector(0.1, 0.0, 0.0)
    before, after = scene()["block"], module(scene())["block"]
    moved = before.vertices.clone()
    moved[3] += before.transform[:3, 0] * 0.1
    assert torch.allclose(after.vertices, moved)


@pytest.mark.parametrize(
    "module", [Translation("block"), Scale("block", 1.3), Vertices("block", 8)]
)
def test_gradients_of_single_modules(module):
    inputs = [p.detach().clone().requires_grad_() for p in module.parameters()]
    assert torch.autograd.gradcheck(lambda *values: vertices_after(module, *values), inputs)


def test_gradients_through_a_composition():
    module = Compose(
        Vertices("block", 8), Scale("block"), Translation("block"), Pose("block"), Scale("block")
    )
    generator = torch.Generator().manual_seed(3)
    inputs = [
        (p.detach() + 0.1 * torch.randn(p.shape, generator=generator, dtype=p.dtype))
        for p in module.parameters()
    ]
    for value in inputs:
        value.requires_grad_()
    assert torch.autograd.gradcheck(lambda *values: vertices_after(module, *values), inputs)


def test_composition_goes_from_first_to_last():
    other = rotation_from_vector(vector(0.0, 0.0, math.pi / 2))
    turn = Pose("block", rotation=vector(0.0, 0.0, math.pi / 2))
    move = Translation("block", [1.0, 0.0, 0.0])
    stretch = Vertices("block", 8)
    stretch.offsets.data[:, 0] += 1.0
    # Turning about the own centre commutes with moving, but not with shifting the mesh's frame.
    assert torch.allclose(
        Compose(turn, move)(scene())["block"].vertices,
        Compose(move, turn)(scene())["block"].vertices,
    )
    first, last = Compose(turn, stretch)(scene()), Compose(stretch, turn)(scene())
    axis = scene()["block"].transform[:3, 0]
    difference = first["block"].vertices - last["block"].vertices
    assert torch.allclose(difference, (other @ axis - axis).expand(8, 3), atol=1e-12)


def test_material_values_start_where_told_and_keep_the_rest():
    module = MaterialValues("block", permittivity=2.5, diffuse=0.25)
    with torch.no_grad():
        material = module(scene())["block"].material
    assert isinstance(material, RoughDielectric)
    assert material.permittivity == pytest.approx(2.5, rel=1e-14)
    assert material.diffuse == pytest.approx(0.25, rel=1e-14)
    assert material.conductivity == 0.1
    assert material.lobe_width == 0.3
    assert scene()["wall"].material == module(scene())["wall"].material


def test_material_values_cannot_leave_their_range():
    module = MaterialValues(
        "block", permittivity=2.0, conductivity=0.1, diffuse=0.5, lobe_width=0.2
    )
    for extreme in (-30.0, 30.0):
        for parameter in module.parameters():
            parameter.data.fill_(extreme)
        material = module(scene())["block"].material
        assert isinstance(material, RoughDielectric)
        for name in ("permittivity", "conductivity", "diffuse", "lobe_width"):
            value = float(torch.as_tensor(getattr(material, name)).detach())
            assert RANGES[name].low <= value <= RANGES[name].high
        amplitude = material.scattering_law(77e9).amplitude
        assert bool(((amplitude >= 0) & (amplitude <= 1)).all())
        gradients = torch.autograd.grad(amplitude.sum(), [*module.parameters()], allow_unused=True)
        assert all(g is None or bool(g.isfinite()) for g in gradients)


def test_material_values_carry_gradients():
    module = MaterialValues(
        "block", permittivity=2.5, conductivity=0.3, diffuse=0.4, lobe_width=0.2
    )
    parameters = list(module.parameters())
    assert len(parameters) == 4

    def total() -> Tensor:
        surface = module(scene())["block"].material.scattering_law(77e9)
        return surface.amplitude.sum() + surface.lobes.sum() + surface.diffuse

    gradients = torch.autograd.grad(total(), parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        values = []
        for step in (1e-5, -1e-5):
            with torch.no_grad():
                parameter += step
                values.append(float(total()))
                parameter -= step
        difference = (values[0] - values[1]) / 2e-5
        assert abs(difference) > 1e-3
        assert float(gradient) == pytest.approx(difference, rel=1e-6)


SLAB: dict[str, Any] = {
    "permittivity": 2.7,
    "conductivity": 0.1,
    "loss_tangent": 0.01,
    "permeability": 1.2,
    "magnetic_loss_tangent": 0.02,
    "thickness": 12.5e-3,
    "scattering": 0.4,
    "rms_slope": 0.2,
    "lambertian": 0.5,
    "directive": 0.6,
    "directive_exponent": 3.0,
    "backscatter_exponent": 5.0,
}


def test_every_value_of_a_slab_can_be_fitted():
    module = MaterialValues("wall", **SLAB)
    board = Scene({"wall": Object(plate(1.0, 1.0), Slab(2.0, thickness=1e-3))})
    material = module(board)["wall"].material
    assert isinstance(material, Slab)
    for name, value in SLAB.items():
        assert float(getattr(material, name).detach()) == pytest.approx(value, rel=1e-12)
    surface = material.scattering_law(77e9)
    # The exponent of a lobe tells about the slope, the weights about the rest.
    parts = (surface.amplitude, surface.transmittance, surface.extra_length, surface.lobes.square())
    torch.stack([part[1:].sum() for part in parts]).sum().backward()
    assert all(p.grad is not None and torch.isfinite(p.grad) for p in module.parameters())
    for extreme in (-30.0, 30.0):
        for parameter in module.parameters():
            parameter.data.fill_(extreme)
        surface = module(board)["wall"].material.scattering_law(77e9)
        assert all(torch.isfinite(value).all() for value in vars(surface).values())


def test_values_per_triangle_and_textures_can_be_fitted():
    start = torch.tensor([2.0, 3.0], dtype=torch.float64)
    uv = torch.tensor([[0.2, 0.2], [0.8, 0.2], [0.2, 0.8], [0.8, 0.8]], dtype=torch.float64)
    wall = plate(1.0, 1.0)
    pixels = torch.tensor([[0.2, 0.3], [0.4, 0.5]], dtype=torch.float64)
    module = MaterialValues("wall", permittivity=start, diffuse=Texture(pixels, uv, wall.faces))
    material = module(Scene({"wall": Object(wall, RoughDielectric(4.0))}))["wall"].material
    assert isinstance(material, RoughDielectric)
    assert isinstance(material.diffuse, Texture)
    assert torch.allclose(material.diffuse.image, pixels)
    assert torch.allclose(module.values()["wall.permittivity"], start)
    assert torch.allclose(module.values()["wall.diffuse"], pixels)
    surface = material.scattering_law(77e9)
    (surface.amplitude.sum() + surface.diffuse.square().sum()).backward()
    for name, shape in (("permittivity", (2,)), ("diffuse", (2, 2))):
        gradient = module.raw[name].grad
        assert gradient is not None
        assert gradient.shape == shape
        assert (gradient != 0).any()


def test_values_of_one_layer_can_be_fitted():
    stack = Multilayer([Layer(2.7, thickness=12e-3), Layer.itu("glass", thickness=4e-3)])
    board = Scene({"wall": Object(plate(1.0, 1.0), stack)})
    module = MaterialValues("wall", layer=1, thickness=5e-3)
    material = module(board)["wall"].material
    assert isinstance(material, Multilayer)
    assert material.layers[0] == stack.layers[0]
    assert material.layers[1].permittivity == Itu("glass")
    assert float(module.values()["wall.layers[1].thickness"]) == pytest.approx(5e-3)
    material.scattering_law(77e9).transmittance.sum().backward()
    assert float(module.raw["thickness"].grad) != 0
    with pytest.raises(InputError, match="a layer below 2 of 'wall', got 2"):
        MaterialValues("wall", layer=2, thickness=5e-3)(board)
    with pytest.raises(InputError, match="layer with scattering"):
        MaterialValues("wall", layer=0, scattering=0.5)(board)


def test_conductor_lobe_can_be_fitted():
    with torch.no_grad():
        material = MaterialValues("wall", lobe_width=0.2)(scene())["wall"].material
    assert isinstance(material, PerfectConductor)
    assert material.lobe_width == pytest.approx(0.2)


def test_any_module_from_scene_to_scene_composes():
    class Decoder(nn.Module):
        def forward(self, scene: Scene) -> Scene:
            return scene.replace("block", material=PerfectConductor())

    composed = Compose(Decoder(), Scale("block"))
    assert isinstance(composed(scene())["block"].material, PerfectConductor)
    assert list(composed.values()) == ["block.scale"]


def test_values_are_physical_and_detached():
    module = Compose(
        Translation("wall", [1.0, 2.0, 3.0]),
        Pose("block", rotation=[0.0, 0.5, 0.0]),
        Scale("block", 2.0),
        MaterialValues("block", permittivity=3.0),
        Vertices("block", 8),
    )
    values = module.values()
    assert values["wall.translation"].tolist() == [1.0, 2.0, 3.0]
    assert values["block.rotation"].tolist() == pytest.approx([0.0, 0.5, 0.0])
    assert float(values["block.scale"]) == pytest.approx(2.0)
    assert float(values["block.permittivity"]) == pytest.approx(3.0)
    assert values["block.offsets"].shape == (8, 3)
    assert not any(value.requires_grad for value in values.values())


def test_state_survives_saving():
    saved = Compose(
        Pose("block", [1.0, 2.0, 3.0], [0.1, 0.2, 0.3]), MaterialValues("block", diffuse=0.3)
    )
    restored = Compose(Pose("block"), MaterialValues("block", diffuse=0.9))
    restored.load_state_dict(saved.state_dict())
    for name, value in saved.values().items():
        assert torch.equal(restored.values()[name], value)


def test_initial_values_are_copied():
    start = vector(1.0, 2.0, 3.0)
    module = Translation("block", start)
    module.translation.data += 1.0
    assert start.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Translation("block", [1.0, 2.0]), "initial translation"),
        (lambda: Translation("block", [1.0, 2.0, math.nan]), "finite initial translation"),
        (lambda: Translation("floor")(scene()), "block, wall, got 'floor'"),
        (lambda: Pose("block", rotation=[0.0] * 4), "4 that are not all zero"),
        (lambda: Pose("block", rotation=[1.0] * 5), "rotation of 3 numbers, or 4"),
        (lambda: Pose("block", rotation=1.0), "initial rotation as numbers"),  # pyright: ignore[reportArgumentType]
        (lambda: Scale("block", 0.0), "initial scale"),
        (lambda: Vertices("block", 0), "number of vertices"),
        (lambda: Vertices("block", 7)(scene()), "expected 7 vertices in 'block', got 8"),
        (lambda: MaterialValues("block"), "at least one of permittivity"),
        (lambda: MaterialValues("block", colour=1.0), "at least one of permittivity.*got colour"),
        (lambda: MaterialValues("block", layer=0, thickness=1.0)(scene()), "a layer below 0"),
        (lambda: MaterialValues("block", thickness=0.0), r"inside \(0, inf\), got 0"),
        (lambda: MaterialValues("block", permittivity=1.0), r"inside \(1, inf\), got 1"),
        (lambda: MaterialValues("block", permittivity=0.5), r"\[1, 1e\+15\], got 0.5"),
        (lambda: MaterialValues("block", diffuse=1.0), r"inside \(0, 1\), got 1"),
        (lambda: MaterialValues("wall", permittivity=2.0)(scene()), "material with permittivity"),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
