"""Chirp trains of moving scenes with ray tracing at keyframes only.

Visibility at the middle of a few loops is used for all of them. Points stay on their triangles, so
that delays and Doppler are exact in every sample. Static paths are summed once. A trace costs much
more than a ramp of the moving paths: with one for 64 loops, a frame of a walking person in a room
takes about a fortieth of the time.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from invertwin.channel import Paths
from invertwin.errors import InputError
from invertwin.radar.radar import Radar, require_sampled_waveform
from invertwin.radar.signal import nufft
from invertwin.radar.signal.chirps import Chirps, ChirpTrain, sample_interval
from invertwin.radar.signal.range_profile import beat_signal, check_paths
from invertwin.scene.mesh import concatenate_meshes
from invertwin.scene.scene import Scene

_TRAJECTORY_TOLERANCE = 1e-7  # tolerance of polynomial trajectories [m]
_DEGREES = (4, 8, 16, 32, 64)
_CHECK_SHARES = (0.109, 0.317, 0.489, 0.683, 0.947)  # relative times of its check


class VisibilityKeyframes:
    """Ramps from points visible at the middle of several loops, which follow their surfaces.

    Args:
        motion: scene as a function of time [s].
        trace: returns the one-bounce paths of a scene, without boundary paths.
        radar: radar that records.
        chirps: chirp timing.
        loops: number of loops per trace.
    """

    def __init__(
        self,
        motion: Callable[[float], Scene],
        trace: Callable[[Scene], Paths],
        radar: Radar,
        chirps: Chirps,
        loops: int,
    ) -> None:
        self.motion, self.trace, self.radar, self.loops = motion, trace, radar, loops
        self.starts = chirps.times(radar.shape[1])
        waveform = require_sampled_waveform(radar)
        self.last = (waveform.samples - 1) * sample_interval(waveform)
        self.number, self.still, self.train = -1, torch.zeros(0), None

    def simulate_ramp(self, start: float, transmitters: list[int]) -> Tensor:
        """Simulate the signals of one ramp [frame, transmitter, rx, sample].

        Args:
            start: time of its first sample [s].
            transmitters: active transmitters.
        """
        loop = int((self.starts.amin(1) <= start).sum()) - 1
        if loop // self.loops != self.number:
            self.number = loop // self.loops
            self._start_keyframe()
        still = self.still[:, transmitters]
        if self.train is None:
            return still
        return still + self.train.simulate_ramp(start, transmitters)

    def _start_keyframe(self) -> None:
        own = self.starts[self.number * self.loops : (self.number + 1) * self.loops]
        begin, end = float(own.min()), float(own.max()) + self.last
        scene = self.motion(0.5 * (begin + end))
        paths = self.trace(scene)
        check_paths(paths, self.radar, require_sampled_waveform(self.radar))
        assert paths.face is not None
        assert paths.barycentric is not None
        whole = concatenate_meshes([item.mesh for item in scene.objects.values()])
        corners = whole.faces[paths.face]
        vertices = _VertexTrajectories(self.motion, scene, begin, end)
        moves = vertices.moves[corners].any(1)
        self.still = beat_signal(paths.select(~moves), self.radar)
        rows = torch.nonzero(moves)[:, 0]
        own_corners, share = corners[rows], paths.barycentric[rows]
        weights = torch.cat([1 - share.sum(1, keepdim=True), share], dim=1)
        nodes = torch.einsum("kpcx,pc->kpx", vertices.nodes[:, own_corners], weights)
        self.train = None
        if len(rows):
            moving = paths.select(rows)
            trajectory = partial(vertices.interpolate, nodes)
            here = trajectory(0.5 * (begin + end))
            moving = replace(moving, first=here, last=here, velocity=None)
            self.train = ChirpTrain(moving, self.radar, trajectory)


class _VertexTrajectories:
    """Trajectories of all vertices over an interval: polynomials through Chebyshev nodes.

    The number of nodes is doubled until the interpolation error is within the tolerance.

    Attributes:
        nodes: vertices at the nodes [node, vertex, 3].
        moves: mask of the moving vertices.
    """

    def __init__(
        self, motion: Callable[[float], Scene], scene: Scene, begin: float, end: float
    ) -> None:
        def vertices(time: float) -> Tensor:
            other = motion(time)
            vertex_displacements(scene, other)
            return torch.cat([item.vertices for item in other.objects.values()]).double()

        tried = [begin + share * (end - begin) for share in _CHECK_SHARES]
        known = [(time, vertices(time)) for time in tried]
        for degree in _DEGREES:
            # Chebyshev's nodes, as those of a ramp from 0 to 1.
            self.places = begin + nufft.ramp_instants(2, degree + 1) * (end - begin)
            self.nodes = torch.stack([vertices(time) for time in self.places.tolist()])
            off = (float((self.interpolate(self.nodes, t) - v).abs().max()) for t, v in known)
            if all(error < _TRAJECTORY_TOLERANCE for error in off):
                break
        else:
            raise InputError(
                f"expected motion that is smooth over {end - begin:.3g} s, got one that 65 "
                "instants do not follow; lower visibility_every"
            )
        self.moves = ((self.nodes - self.nodes[:1]).abs() > 0).flatten(2).any(2).any(0)

    def interpolate(self, nodes: Tensor, time: float) -> Tensor:
        """Interpolate values at the nodes at a time.

        Args:
            nodes: values [node, …].
            time: time [s].
        """
        apart = time - self.places
        exact = (apart == 0).nonzero()
        if len(exact):
            return nodes[int(exact[0, 0])]
        # Barycentric weights of these nodes are ±1, ±½ at the ends.
        weights = nufft.barycentric_weights(len(apart)) / apart
        return torch.tensordot(weights / weights.sum(), nodes, dims=1)


def vertex_displacements(scene: Scene, other: Scene) -> dict[str, Tensor]:
    """Return the displacements of the vertices between two instants [m], by object.

    Args:
        scene: scene at one instant.
        other: scene at another instant.

    Raises:
        InputError: Other objects or triangles.
    """
    if scene.names != other.names:
        raise InputError(
            f"expected the same objects at all times, got {', '.join(scene.names)} and "
            f"{', '.join(other.names)}; move objects out of sight instead of leaving them out"
        )
    found = {}
    for name in scene.names:
        here, there = scene[name], other[name]
        if not torch.equal(here.mesh.faces, there.mesh.faces):
            raise InputError(
                f"expected the same triangles of {name!r} at all times, got others; "
                "move its vertices only"
            )
        found[name] = (there.vertices - here.vertices).detach()
    return found
