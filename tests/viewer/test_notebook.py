"""What notebooks show."""

import importlib.util
import re
import signal
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch

from invertwin import Observation, Schedule, SurrogateMap, reconstruct, simulate
from invertwin.capture import Capture
from invertwin.channel import Sampling
from invertwin.inversion import Checkpoint, Report, report_progress
from invertwin.radar import FMCW, Radar
from invertwin.scene import Object, RoughDielectric, Scene, Translation, box, planar_array, rigid
from invertwin.viewer.notebook import PAGES, register_formatters, show

EVIL = "<script>alert(1)</script>"


def shown_html(value: object) -> str:
    """The page that is registered for the type of a value."""
    return PAGES[type(value)](value)


def scene() -> Scene:
    pose = rigid(translation=torch.tensor([2.0, 0.0, 0.0]).double())
    return Scene({EVIL: Object(box((0.2, 0.4, 0.3)), RoughDielectric(4.0), pose)})


def radar() -> Radar:
    one, array = (planar_array((n, 1), (1.9e-3, 1.9e-3)) for n in (1, 8))
    return Radar(one, array, FMCW(77e9, 1.5e9, 5e-5, 64), torch.zeros(1, 3).double())


def cells(text: str) -> list[str]:
    return re.findall(r"<td>(.*?)</td>", text)


def test_a_scene_shows_its_objects_and_runs_no_name():
    shown = shown_html(scene())
    assert shown.startswith('<img alt="three views of the scene" src="data:image/png;base64,')
    name, count, material, size, middle = cells(shown)
    assert name == "&lt;script&gt;alert(1)&lt;/script&gt;"
    assert (count, material, size) == ("12", "RoughDielectric", "0.2 × 0.4 × 0.3")
    assert middle == "2, 0, 0"


def test_a_running_ipython_gets_the_pages(monkeypatch):
    registered = {}
    formatter = SimpleNamespace(for_type=registered.__setitem__)
    display = SimpleNamespace(formatters={"text/html": formatter})
    module = ModuleType("IPython")
    shells: list[Any] = [SimpleNamespace(display_formatter=display)]
    module.get_ipython = lambda: shells[0]
    monkeypatch.setitem(sys.modules, "IPython", module)
    register_formatters()
    assert registered == PAGES
    assert "<table>" in registered[type(radar())](radar())
    shells[0] = None
    register_formatters()


def test_a_radar_shows_what_it_resolves():
    rows = cells(shown_html(radar()))
    found = dict(zip(rows[::2], rows[1::2], strict=True))
    assert found["transmitters × receivers"] == "1 × 8"
    assert float(found["range cell [m]"]) == pytest.approx(299792458 / 2 / 1.5e9, rel=1e-3)


def fit(folder, callbacks=(), steps=6):
    grid = radar().grid(1.0, 3.0, 0.5, 0.5)
    beat = simulate(scene(), radar(), grid, seed=1, sampling=Sampling(1, 5000)).beat
    capture = Capture.from_beat(beat, radar())
    model = SurrogateMap(grid, sampling=Sampling(1, 5000, 1000))
    begun = scene().replace(EVIL, pose=rigid(translation=torch.tensor([2.05, 0.1, 0.0]).double()))
    return capture, reconstruct(
        begun,
        Observation(model, capture, sensor=radar()),
        [Translation(EVIL)],
        schedule=Schedule(steps=steps),
        callbacks=[*callbacks, Checkpoint(folder / "fit.pt", every=1, resume=True)],
        seed=1,
    )


def test_a_capture_and_a_fit_show_themselves(tmp_path):
    capture, found = fit(tmp_path)
    assert 'alt="map of the first frame"' in shown_html(capture)
    shown = shown_html(found)
    assert 'alt="loss over the steps"' in shown
    assert "<script" not in shown
    rows = cells(shown)
    assert rows[rows.index("steps") + 1] == "6"
    assert "verdict" not in rows
    assert vars(found).get("verdict") is None  # looking computes nothing
    assert found.verdict.word in cells(shown_html(found))


@pytest.fixture
def interruptible():
    """Ctrl-C as in a fresh process; workers of tests before may ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_a_fit_that_is_stopped_goes_on_as_if_it_had_not_been(tmp_path, capsys):
    (tmp_path / "a").mkdir()
    whole = fit(tmp_path / "a")[1]
    (tmp_path / "b").mkdir()

    class Stop:
        """Presses Ctrl-C in the middle of the third step."""

        def __init__(self) -> None:
            self.count = 0

        def __call__(self, row: dict) -> None:
            self.count += 1
            if self.count == 3:
                signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), report_progress("fit", 6) as shown:
        fit(tmp_path / "b", [Report(Stop()), *shown])
    assert "fit: step 3 of 6" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    again = fit(tmp_path / "b")[1]
    assert again.loss == whole.loss
    assert again.scene[EVIL].center.tolist() == whole.scene[EVIL].center.tolist()


@pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason='needs: pip install "invertwin[view]"'
)
def test_a_scene_opens_its_viewer(capsys):
    grid = radar().grid(1.0, 3.0, 0.5, 0.5)
    with show(scene(), radar=radar(), grid=grid, port=0) as viewer:
        assert viewer.address in capsys.readouterr().out
        assert viewer.address.startswith("http://127.0.0.1:")
