"""Digital twins from radar: differentiable ray-traced radar simulation, visibility included.

Data flows one way. ``scene`` turns parameters θ (``scene/parameters.py``) into meshes, materials
and antennas; ``channel`` traces them into paths; ``radar`` makes beat signals and spectra of paths,
or their smooth mean, the surrogate; ``links`` makes responses of paths between antennas;
``inversion`` compares spectra with a capture and moves θ; ``discovery`` finds what there is.
``simulation.py`` has exact signals on one page. Beside it, ``capture`` holds
measured data, ``datasets`` simulated ones with labels, ``plotting`` draws figures, ``viewer``
shows scenes in a browser, ``registry`` says what run files may name and ``cli`` has the commands.

The names of ``__init__.pyi`` are the public menu. Each is loaded when it is first used, so
``import invertwin`` is quick, and ``invertwin doctor`` runs where no ray tracer can.
"""

import sys

import lazy_loader

from invertwin.deprecation import rename_attributes
from invertwin.runtime import doctor, threads

__version__ = "0.4.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
rename_attributes(__name__)

# Libraries read how many threads to start while they are being loaded.
threads.set_thread_environment()
# Dr.Jit picks its libLLVM while it is being imported: before any module can do that.
doctor.select_libllvm()

if "IPython" in sys.modules:
    from invertwin.viewer.notebook import register_formatters

    register_formatters()
