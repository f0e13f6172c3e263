"""Digital twins from radar: differentiable ray-traced radar simulation, visibility included.

Data flows one way. ``scene`` turns parameters θ (``scene/parameters.py``) into meshes, materials
and antennas; ``channel`` traces them into paths; ``radar`` makes beat signals and spectra of paths,
or their smooth mean, the surrogate; ``links`` makes responses of paths between antennas;
``inversion`` compares spectra with a capture and moves θ; ``discovery`` finds what there is.
``simulation.py`` is the way from scene to spectrum on one page. Beside it, ``capture`` holds
measured data, ``datasets`` simulated ones with labels, ``plotting`` draws figures, ``viewer``
shows scenes in a browser, ``registry`` says what run files may name and ``cli`` has the commands.

The names below are the public menu. Each is loaded when it is first used, so ``import invertwin``
is quick, and ``invertwin doctor`` runs where no ray tracer can.
"""

from importlib import import_module
from typing import Any

from invertwin.runtime import doctor, threads

__version__ = "0.3.0"

_ROOMS = (
    "capture",
    "channel",
    "datasets",
    "discovery",
    "inversion",
    "links",
    "plotting",
    "radar",
    "scene",
    "viewer",
)

# Name → module.
_MENU = {
    "Capture": "capture.capture",
    "ExactMap": "models",
    "FMCW": "radar.waveform",
    "Grid": "channel",
    "InputError": "errors",
    "Object": "scene.scene",
    "MotionMap": "models",
    "Observation": "inversion.observation",
    "Radar": "radar.radar",
    "RadioMap": "models",
    "Sampling": "channel",
    "Scene": "scene.scene",
    "SpectrumLoss": "inversion.loss",
    "Schedule": "inversion.schedule",
    "Surrogate": "radar.surrogate",
    "SurrogateMap": "models",
    "dataset": "cli.run_dataset",
    "gradcheck": "inversion.gradcheck",
    "load_mesh": "scene.files",
    "rcs": "signatures",
    "reconstruct": "inversion.reconstruction",
    "search": "inversion.minima",
    "simulate": "simulation",
    "simulate_chirps": "simulation",
    "trace_paths": "channel",
    "twin": "discovery",
}

__all__ = ["__version__", *_MENU, *_ROOMS]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return import_module(f"invertwin.{name}")
    if name not in _MENU:
        raise AttributeError(f"module 'invertwin' has no attribute {name!r}")
    value = getattr(import_module(f"invertwin.{_MENU[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


# Libraries read how many threads to start while they are being loaded.
threads.prepare()
# Dr.Jit picks its libLLVM while it is being imported: before any module can do that.
doctor.prepare()
