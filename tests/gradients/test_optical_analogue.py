"""The derivative of a moving occluder against Mitsuba's own projective sampling.

An area light that lights a camera's scene is a transmitter at every place of the light, with a
cosine pattern; the camera's pixels, weighted by their solid angle, are the receiver's directions.
Light needs no range, so all of it falls into one range bin, and both sides are the same integral
up to one constant.
"""

from typing import Any

import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power
from invertwin.channel.rays.backend import mi as raytracer
from invertwin.scene import (
    Cosine,
    Isotropic,
    Mesh,
    Object,
    RoughConductor,
    Scene,
    plate,
)
from scenes import WAVELENGTH, float64, relative, thing

CAMERA = (0.0, -0.3, 0.0)
LIGHT, SIDE = (0.0, 0.5, 0.2), 0.3
PLACES = 12  # transmitters along each side of the light
GRID = Grid(0.0, 1000.0, 1, u_start=-0.3, u_step=0.1, u_count=8)
WHITE = RoughConductor(scattering=1.0)
WALL = thing(plate(2.0, 1.4), (2.0, 0.0, 0.0), (0.0, 0.0, 0.1), WHITE)
SCREEN = thing(plate(0.45, 0.35), (1.2, 0.05, 0.05), (0.4, 0.1, 0.2), WHITE)


def ours(shift: Tensor, seed: int, samples: int, boundary: bool) -> Tensor:
    """Power by direction, the mean over the places of the light."""
    steps = (torch.arange(PLACES).double() + 0.5) / PLACES - 0.5
    y, z = torch.meshgrid(steps * SIDE, steps * SIDE, indexing="ij")
    tx = torch.stack([0 * y, y, z], dim=-1).reshape(-1, 3) + float64(LIGHT)
    rotations = torch.eye(3, dtype=torch.float64).expand(len(tx), 3, 3)
    rx = float64(CAMERA).expand(len(tx), 3)
    antennas = Link(tx, rx, rotations, Cosine(1.0), Isotropic(), WAVELENGTH, False)
    offset = torch.stack([0 * shift, shift, 0 * shift])
    moved = Object(Mesh(SCREEN.vertices + offset, SCREEN.mesh.faces), WHITE)
    scene = Scene({"wall": WALL, "screen": moved})
    out = deposit_power(
        scene,
        antennas,
        GRID,
        sampling=Sampling(
            depth=1, samples=samples, boundary_samples=samples // 4, boundary=boundary
        ),
        seed=seed,
    )
    return out.double().mean(0)[0, :, 0]


def quads(mi: Any, item: Object) -> Any:
    """A mesh of an object in Mitsuba, white."""
    bsdf = mi.load_dict({"type": "twosided", "b": {"type": "diffuse", "reflectance": 1.0}})
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    vertices, faces = item.vertices, item.mesh.faces
    mesh = mi.Mesh("mesh", len(vertices), len(faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(vertices.float().numpy().ravel())
    parameters["faces"] = mi.UInt32(faces.numpy().astype(np.uint32).ravel())
    parameters.update()
    return mesh


def mitsuba(seeds: int, size: int = 128) -> tuple[Tensor, Tensor, float]:
    """The image, its derivative by ``direct_projective``, and the noise of the derivative."""
    raytracer.variant()  # loads it as we do
    import drjit as dr
    import mitsuba as mi

    before = str(mi.variant())
    mi.set_variant("llvm_ad_mono")
    try:
        to_world = mi.ScalarTransform4f
        fov = 72.0
        scene = mi.load_dict(
            {
                "type": "scene",
                "wall": quads(mi, WALL),
                "screen": quads(mi, SCREEN),
                "light": {
                    "type": "rectangle",  # of side 2, facing +z before it is turned
                    "to_world": to_world()
                    .translate(LIGHT)
                    .rotate([0, 1, 0], 90)
                    .scale([SIDE / 2, SIDE / 2, 1]),
                    "emitter": {"type": "area", "radiance": 1.0},
                },
                "sensor": {
                    "type": "perspective",
                    "fov": fov,
                    "near_clip": 0.01,
                    "to_world": to_world().look_at(
                        CAMERA, (1.0, CAMERA[1], CAMERA[2]), (0.0, 0.0, 1.0)
                    ),
                    "film": {
                        "type": "hdrfilm",
                        "width": size,
                        "height": size,
                        "pixel_format": "luminance",
                        "rfilter": {"type": "box"},
                        "sample_border": True,
                    },
                },
            }
        )
        integrator = mi.load_dict({"type": "direct_projective", "sppi": 512, "sppp": 64})
        parameters = mi.traverse(scene)
        key = next(k for k, _ in parameters.items() if "screen" in k and "vertex_positions" in k)
        still = mi.Float(parameters[key])
        images, slopes = [], []
        for seed in range(seeds):
            theta = mi.Float(0.0)
            dr.enable_grad(theta)
            offset = mi.Point3f(0.0, theta, 0.0)
            parameters[key] = dr.ravel(dr.unravel(mi.Point3f, still) + offset)
            parameters.update()
            image = mi.render(
                scene, parameters, integrator=integrator, spp=256, spp_grad=64,
                seed=mi.UInt32(seed), seed_grad=1000 + seed,
            )  # fmt: skip
            dr.forward(theta)
            slope = dr.grad(image)
            images.append(np.array(image)[..., 0])
            slopes.append(np.array(slope)[..., 0])
    finally:
        mi.set_variant(before)
    half = np.tan(np.radians(fov / 2))
    steps = ((np.arange(size) + 0.5) / size * 2 - 1) * half
    y, z = np.meshgrid(-steps, -steps)
    secant = np.sqrt(1 + y**2 + z**2)
    t = torch.from_numpy((y / secant - GRID.u_start) / GRID.u_step)
    gap = (t[..., None] - torch.arange(GRID.u_count)).abs()
    spline = torch.where(
        gap < 0.5, 0.75 - gap**2, torch.where(gap < 1.5, 0.5 * (1.5 - gap) ** 2, 0.0)
    )
    weights = spline * torch.from_numpy(secant**-3.0)[..., None]
    binned = [
        torch.einsum("szy,zyu->su", torch.from_numpy(np.stack(found)).double(), weights)
        for found in (images, slopes)
    ]
    slope = binned[1].mean(0)
    error = binned[1].std(0) / seeds**0.5
    return binned[0].mean(0), slope, float(error.sum() / slope.abs().sum())


@pytest.mark.slow
def test_the_optical_analogue_has_mitsubas_gradient():
    """Bin by bin to 2 %; fixed visibility alone is far off."""
    image, slope, noise = mitsuba(2)
    pushed, values, inside = [], [], []
    for seed in range(2):
        for boundary, found in ((True, pushed), (False, inside)):
            with forward_ad.dual_level():
                shift = forward_ad.make_dual(float64(0.0), float64(1.0))
                value, tangent = forward_ad.unpack_dual(ours(shift, seed, 2_000_000, boundary))
            found.append(tangent)
        values.append(value)
    value, full, interior = (torch.stack(rows).mean(0) for rows in (values, pushed, inside))
    scale = image.sum() / value.sum()
    assert relative(scale * value, image) < 0.002
    assert noise < 0.01
    assert relative(scale * full, slope) < 0.02
    assert relative(scale * interior, slope) > 0.3
