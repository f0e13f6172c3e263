"""What Sionna RT, where it is installed, says about the derivative of a map by a moving mesh.

Its path solver detaches the places of its paths before it computes their fields, so that of the
geometry's derivatives nothing remains; the strengths, delays and directions are asked all the
same, and what they answer is what is shown.
"""

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel import Grid
from invertwin.channel.rays.arrays import to_float, to_index, to_torch
from invertwin.channel.rays.backend import mi
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.scene.scene import Scene
from invertwin_studies.peers.binning import binned

# Sionna's receiver beside its transmitter [m]: at one place a path would have no direction.
_BESIDE = 1e-3


def sionna_version() -> str | None:
    """Installed version of Sionna RT, if any."""
    try:
        return version("sionna-rt")
    except PackageNotFoundError:
        return None


def sionna_derivative(
    scene: Scene,
    radar: Radar,
    grid: Grid,
    direction: Callable[[Scene, Radar, Tensor], tuple[Scene, Radar]],
    *,
    surrogate: Surrogate,
    samples: int,
    seed: int,
) -> Float64[Tensor, "frame range u v"]:
    """Derivative of the map of Sionna's diffuse single-bounce paths, shaped by our surrogate.

    All surfaces scatter all their power diffusely. The vertices carry θ into Sionna; the powers,
    delays and angles of its paths are differentiated forward and binned as ours are.

    Args:
        scene: The scene at θ = 0.
        radar: Its radar; the antennas are isotropic for Sionna.
        grid: Bins of the map.
        direction: θ → scene and radar; only what it does to vertices is passed on.
        surrogate: Point spread of the map.
        samples: Rays from the antenna in each frame.
        seed: Of Sionna's solver.
    """
    with torch.no_grad(), forward_ad.dual_level():
        theta = forward_ad.make_dual(
            torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
        )
        moved, _ = direction(scene, radar, theta)
        vertices = {
            name: forward_ad.unpack_dual(item.vertices) for name, item in moved.objects.items()
        }
    maps = []
    for frame in range(radar.frame_count):
        columns = _paths(scene, vertices, radar, frame, samples, seed)
        maps.append(_binned_derivative(columns, radar, frame, grid))
    return surrogate.shape(torch.cat(maps), radar, grid)


def _paths(
    scene: Scene, vertices: dict[str, Any], radar: Radar, frame: int, samples: int, seed: int
) -> list[tuple[Tensor, Tensor]]:
    """Power, delay, polar and azimuth angle of departure of all paths, with tangents."""
    rt = import_module("sionna.rt")
    import drjit as dr

    room = rt.load_scene()
    room.frequency = radar.waveform.center_frequency
    for name, item in scene.objects.items():
        mesh = mi.Mesh(name, vertex_count=len(item.mesh.vertices), face_count=len(item.mesh.faces))
        parameters = mi.traverse(mesh)
        parameters["faces"] = to_index(item.mesh.faces)
        parameters["vertex_positions"] = to_float(vertices[name].primal)
        parameters.update()
        permittivity = float(getattr(item.material, "permittivity", 1.0))
        rough = rt.RadioMaterial(
            f"of {name}", relative_permittivity=permittivity, scattering_coefficient=1.0
        )
        room.edit(add=rt.SceneObject(mi_mesh=mesh, name=name, radio_material=rough))
    parameters = mi.traverse(room.mi_scene)
    attached = []
    for name, moved in vertices.items():
        if moved.tangent is not None:
            positions = to_float(moved.primal)
            dr.enable_grad(positions)
            dr.set_grad(positions, to_float(moved.tangent))
            parameters[f"{name}.vertex_positions"] = positions
            attached.append(positions)
    parameters.update()
    room.tx_array = room.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    place = radar.link().tx[frame].detach().tolist()
    room.add(rt.Transmitter("tx", place))
    room.add(rt.Receiver("rx", [place[0], place[1] + _BESIDE, place[2]]))
    solver = rt.PathSolver()
    solver.loop_mode = "evaluated"  # the other mode refuses a derivative from outside
    paths = solver(
        room,
        max_depth=1,
        samples_per_src=samples,
        los=False,
        specular_reflection=False,
        diffuse_reflection=True,
        refraction=False,
        seed=seed + 1,
    )
    power = dr.square(paths.a[0].array) + dr.square(paths.a[1].array)
    columns = [power, paths.tau.array, paths.theta_t.array, paths.phi_t.array]
    dr.enqueue(dr.ADMode.Forward, attached)
    dr.traverse(dr.ADMode.Forward)
    found = to_torch(paths.valid.array).bool()
    return [
        (to_torch(column)[found].double(), _tangent(dr.grad(column), found)) for column in columns
    ]


def _tangent(values: Any, found: Tensor) -> Tensor:
    """A column without derivative has a single zero."""
    tangent = torch.from_numpy(np.broadcast_to(np.array(values), found.shape).copy())
    return tangent[found].double()


def _binned_derivative(
    columns: list[tuple[Tensor, Tensor]], radar: Radar, frame: int, grid: Grid
) -> Tensor:
    with torch.no_grad(), forward_ad.dual_level():
        power, delay, polar, azimuth = (forward_ad.make_dual(*column) for column in columns)
        ray = torch.stack(
            [polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()], dim=1
        )
        local = ray @ radar.link().rotations[frame]
        total = binned(
            torch.zeros(len(power), dtype=torch.int64),
            power,
            0.5 * SPEED_OF_LIGHT * delay,
            local[:, 1],
            local[:, 2],
            grid,
        )
        tangent = forward_ad.unpack_dual(total).tangent
        return torch.zeros_like(total) if tangent is None else tangent
