"""A ball that moves before a wall, seen by two sensors; one of the names tries to act."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch

from invertwin.radar import FMCW, Radar
from invertwin.scene import (
    Object,
    RoughDielectric,
    Scene,
    planar_array,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
)
from invertwin.viewer import (
    MEASURED,
    Display,
    DisplayMaps,
    DisplayMesh,
    DisplayStep,
    InteractiveSensor,
    build_display,
    display_mesh,
)

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


@cache
def shown() -> tuple[Display, dict[str, InteractiveSensor]]:
    """At step k the ball is at y = 0.2 k m, x = 2 m; measured at y = 0.5 m. One sensor is aside."""
    material = RoughDielectric(4.0)
    ball = Object(sphere(0.3, 4), material, rigid(translation=[2.0, 0.0, 0.0]))
    wall = Object(plate(3.0, 2.4), material, rigid(translation=[3.3, 0.0, 0.0]))
    scene = Scene({EVIL: ball, "wall": wall})
    body, away = display_mesh(ball), np.array([0.0, 0.2, 0.0], np.float32)
    steps = [
        DisplayStep(k, f"{EVIL} {k}", {EVIL: DisplayMesh(body.vertices + k * away, body.faces)})
        for k in range(5)
    ]
    one, array = planar_array((1, 1), (1.9e-3, 1.9e-3)), planar_array((16, 4), (1.9e-3, 1.9e-3))
    waveform = FMCW(77e9, 2e9, 50e-6, 128)
    places = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.8, 0.0]], dtype=torch.float64)
    turned = rotation_from_vector(torch.tensor([0.0, 0.0, np.pi / 2], dtype=torch.float64))
    beside = torch.tensor([[2.0, -2.5, 0.0]], dtype=torch.float64)
    radars = {
        "front": Radar(one, array, waveform, places),
        EVIL: Radar(one, array, waveform, beside, turned[None]),
    }
    grids = {name: radar.grid(1.0, 4.5, 0.6, 0.5) for name, radar in radars.items()}
    links = {name: InteractiveSensor(scene, radar, grids[name]) for name, radar in radars.items()}
    truth = links["front"].move_object(EVIL, rigid(translation=[0.0, 0.5, 0.0]))
    maps = {
        name: DisplayMaps.from_spectra(
            {
                MEASURED: torch.stack(
                    [link.predict_map(truth, k)[..., None] for k in range(link.radar.frame_count)]
                )
            },
            grids[name],
        )
        for name, link in links.items()
    }
    sights = {name: (radar, grids[name]) for name, radar in radars.items()}
    made = build_display(scene, sights, EVIL, fitted=[EVIL])
    return replace(made, steps=steps, maps=maps), links
