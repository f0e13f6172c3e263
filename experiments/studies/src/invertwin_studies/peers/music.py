"""Derivatives of MUSIC spectra of exact signals: what fits without a surrogate would follow.

Visibility is fixed in the automatic derivative: a rough surface's field is a sum over points that
appear and vanish, and has no boundary term.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel import Grid, Sampling, Speckle, trace_field
from invertwin.radar.processing.direction import music
from invertwin.radar.radar import Radar
from invertwin.radar.signal.range_profile import beat_signal, range_profile
from invertwin.scene.scene import Scene

_SAMPLES = 200_000  # on coherent objects

Moves = Callable[[Scene, Radar, Tensor], tuple[Scene, Radar]]
"""θ → scene and radar."""


@dataclass(frozen=True)
class MusicMap:
    """MUSIC pseudospectra of a scene's exact signals, of one set of rough points.

    Attributes:
        radar: Its radar.
        grid: Bins.
        speckle: Rough points, the same wherever the scene moves.
        sources: Per range bin.
        smoothing: Elements of the subarrays along y and z.
        seed: Of coherent paths.
    """

    radar: Radar
    grid: Grid
    speckle: Speckle
    sources: int
    smoothing: tuple[int, int]
    seed: int

    def beat(
        self, scene: Scene, radar: Radar | None = None
    ) -> Complex128[Tensor, "frame tx rx sample"]:
        """Exact beat signal of the scene.

        Args:
            scene: What is seen.
            radar: What sees it, perhaps moved; None = the attribute.
        """
        seen = radar or self.radar
        paths = trace_field(
            scene,
            seen.link(),
            sampling=Sampling(depth=1, conductor_samples=_SAMPLES, boundary=False),
            seed=self.seed,
            speckle=self.speckle,
        )
        return beat_signal(paths, seen)

    def spectrum(
        self, beat: Complex128[Tensor, "frame tx rx sample"]
    ) -> Float64[Tensor, "frame range u v"]:
        """MUSIC of a beat signal at the grid's bins."""
        return music(
            range_profile(beat, self.radar, self.grid)[:, None],
            self.radar,
            self.grid,
            sources=self.sources,
            smoothing=self.smoothing,
            forward_backward=True,
        )

    def difference(
        self, scene: Scene, direction: Moves, step: float
    ) -> Float64[Tensor, "frame range u v"]:
        """Central difference of the spectrum in θ.

        Args:
            scene: At θ = 0.
            direction: Gives the scene and the radar at a θ.
            step: Of θ.
        """
        with torch.no_grad():
            ends = [
                self.spectrum(
                    self.beat(
                        *direction(
                            scene, self.radar, torch.tensor(sign * step, dtype=torch.float64)
                        )
                    )
                )
                for sign in (1.0, -1.0)
            ]
        return (ends[0] - ends[1]) / (2 * step)

    def derivative(self, scene: Scene, direction: Moves) -> Float64[Tensor, "frame range u v"]:
        """Automatic derivative of the spectrum in θ, by forward mode.

        Args:
            scene: At θ = 0.
            direction: Gives the scene and the radar at a θ.
        """
        with torch.no_grad(), forward_ad.dual_level():
            theta = forward_ad.make_dual(
                torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
            )
            found = self.spectrum(self.beat(*direction(scene, self.radar, theta)))
            tangent = forward_ad.unpack_dual(found).tangent
            return torch.zeros_like(found) if tangent is None else tangent
