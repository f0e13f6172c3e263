"""What every test shares: run-time shape checks, the data folder, the markers, a browser."""

import importlib.util
import os
import shutil
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from jaxtyping import config, install_import_hook

# Before torch, Dr.Jit and matplotlib are imported: no display, and one thread for torch, whose
# operations here are small. On a busy machine two threads that wait for each other cost eightfold.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

# Workers of pytest-xdist share the cores out among themselves, before Dr.Jit starts a thread for
# every core that it may use. What a worker starts inherits its share.
if "PYTEST_XDIST_WORKER" in os.environ and hasattr(os, "sched_setaffinity"):
    cores, workers = sorted(os.sched_getaffinity(0)), int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    number = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw"))
    os.sched_setaffinity(0, cores[number % len(cores) :: workers])

# Shape annotations are executed by `make test-all` only; users pay nothing for them. The numeric
# tower of PEP 484: an int is welcome where a float is expected.
if os.environ.get("INVERTWIN_CHECK_TYPES"):
    install_import_hook(
        ["invertwin", "invertwin_convert", "invertwin_studies"],
        "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))",
    )

REPOSITORY = Path(__file__).resolve().parents[1]
# What pytest-xdist starts inherits the environment as it is changed below.
GIVEN = os.environ.get("INVERTWIN_DATA", str(REPOSITORY.parent / "shared" / "data"))
DATA = Path(os.environ.setdefault("INVERTWIN_TEST_DATA", GIVEN))
# A user has no measured data. A test that reads some without the fixture `data_folder` fails
# everywhere, not only on machines without data.
os.environ["INVERTWIN_DATA"] = str(REPOSITORY / "no measured data: ask for the fixture data_folder")


def pytest_configure() -> None:
    """Make the device of `claimed_tensors` known to torch.

    Autograd starts its threads at the first derivative of the process, and modules of tests compute
    some while they are imported.
    """
    import claimed_tensors

    claimed_tensors.register()


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return REPOSITORY


@pytest.fixture
def data_folder(monkeypatch: pytest.MonkeyPatch) -> Path:
    """Measured data: `$INVERTWIN_DATA`, by default `../shared/data` beside the checkout."""
    if not DATA.is_dir():
        pytest.skip(f"no measured data in {DATA}: set INVERTWIN_DATA")
    monkeypatch.setenv("INVERTWIN_DATA", str(DATA))
    return DATA


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Bad input as users meet it: the shape checks of the tests would catch it first."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)


def processor_seconds() -> float:
    """Seconds that processors have worked for this process and its children that have ended."""
    return sum(os.times()[:4])


STARTED = pytest.StashKey[float]()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None]:
    item.stash[STARTED] = processor_seconds()
    yield


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None]:
    """State the processor time of a test, fixtures included, in the JUnit file."""
    try:
        yield
    finally:
        used = processor_seconds() - item.stash[STARTED]
        item.user_properties.append(("processor_seconds", f"{used:.3f}"))


# Before the items are selected by their marks.
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "data_folder" in getattr(item, "fixturenames", ()):
            item.add_marker("data")
    marked = [item for item in items if item.get_closest_marker("gpu")]
    if not marked:
        return
    from invertwin.runtime import doctor

    if doctor.gpu_name() is None:
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no NVIDIA GPU on this machine"))


INSTALL = "run: make test-browser"


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A browser without a window. Chromium and Playwright are optional: tests skip without them."""
    for extra in ("viser", "playwright"):
        if importlib.util.find_spec(extra) is None:
            pytest.skip(f"needs the package {extra}; {INSTALL}")
    from playwright.sync_api import (  # pyright: ignore[reportMissingImports]
        Error,
        sync_playwright,
    )

    # Debian's, or what `playwright install chromium` has fetched.
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    flags = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=found, args=flags)
        except Error:
            pytest.skip(f"needs Chromium; {INSTALL}")
        yield browser
        browser.close()


class Watched:
    """A page whose errors and requests are noted."""

    def __init__(self, browser: Any) -> None:
        self.page = browser.new_page(viewport={"width": 1024, "height": 640})
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.received: list[bytes] = []
        self.page.on("console", self._said)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("dialog", lambda dialog: self.errors.append(dialog.message))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", self._connected)

    def _said(self, message: Any) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def _connected(self, socket: Any) -> None:
        self.requests.append(socket.url)
        socket.on("framereceived", lambda frame: self.received.append(frame))


@pytest.fixture
def watched(chromium: Any) -> Iterator[Watched]:
    """A fresh page."""
    found = Watched(chromium)
    yield found
    found.page.close()
