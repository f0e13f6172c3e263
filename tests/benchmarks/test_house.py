"""The benchmark of the code's shape: what it counts in small packages, and that it reads ours."""

import json

import pytest
from rich.console import Console


@pytest.fixture
def package(tmp_path):
    """Write files of a package: path → source."""

    def write(**sources):
        for name, source in sources.items():
            file = tmp_path / "package" / f"{name.replace('__', '/')}.py"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(source)
        return tmp_path / "package"

    return write


def test_only_public_functions_have_argument_lists(house, package):
    root = package(
        a="def few(one, *rest, two=0, **more): pass\n"
        "def _many(a, b, c, d, e, f, g): pass\n"
        "def outer(a):\n    def inner(a, b, c, d, e, f, g): pass\n"
        "class _Private:\n    def method(self, a, b, c, d, e, f, g): pass\n",
        _hidden="def many(a, b, c, d, e, f, g): pass\n",
    )
    assert house.longest_argument_list(root) == (4, "a.py:few")


@pytest.mark.parametrize(
    ("method", "count"),
    [
        ("def __init__(self, a, b, c, d, e): pass", 5),
        ("def method(self, a, /, b, *, c): pass", 3),
        ("@classmethod\n    def make(cls, a, b): pass", 2),
        ("@staticmethod\n    def make(a, b): pass", 2),
        ("a: int\n    b: int\n    c: int", 0),
    ],
)
def test_methods_count_without_the_object(house, package, method, count):
    root = package(a=f"def none(): pass\nclass Public:\n    {method}\n")
    assert house.longest_argument_list(root)[0] == count


@pytest.mark.parametrize(
    ("body", "relayed"),
    [
        ("return other(boundary_samples=boundary_samples)", True),
        ("return other(1, boundary_samples)", True),
        ("return Table(boundary_samples)", True),
        ("return {'boundary_samples': settings.boundary_samples}", True),
        ("return other(boundary_samples=self.boundary_samples)", True),
        ("return stranger(1, boundary_samples)", False),
        ("return other(boundary_samples, 1)", False),
        ("return other(boundary_samples=2 * boundary_samples)", False),
        ("check(boundary_samples); return other(boundary_samples=boundary_samples)", False),
        ("return other(boundary_samples=0)", False),
        ("return 1", False),
    ],
)
def test_what_is_merely_passed_on(house, package, body, relayed):
    root = package(
        a=f"def asked(boundary_samples, settings, self):\n    {body}\n"
        "def other(first, boundary_samples=0): return first + boundary_samples\n"
        "class Table:\n    boundary_samples: int\n    depth: int\n"
    )
    assert house.relays(root) == (["a.py:asked"] if relayed else [])


LAW = "def law(half, exponents, dr=None):\n    row = 0\n"


@pytest.mark.parametrize(
    "body",
    [
        "return half ** exponents[row]",
        "n = exponents[row]\n    return half.pow(n)",
        "return torch.pow(half, exponents)",
        "return torch.exp(torch.log(half) * exponents)",
        "half **= exponents",
    ],
)
def test_a_lobe_law_is_seen_in_every_spelling(house, package, body):
    root = package(channel__a=LAW + "    " + body, scene__a=LAW + "    " + body)
    assert house.lobe_laws(root) == {"torch": ["channel/a.py:law"], "drjit": []}


def test_laws_in_drjit_are_counted_apart(house, package):
    code = "def {}(half, exponent):\n    return dr.exp(exponent * {}(half))\n"
    root = package(channel__a=code.format("one", "dr.log") + code.format("two", "log_less"))
    assert house.lobe_laws(root) == {"torch": [], "drjit": ["channel/a.py:one", "channel/a.py:two"]}


@pytest.mark.parametrize(
    "body",
    [
        "return half ** 2",
        "return dr.exp(dr.log(half) / (exponents + 1))",
        "return (exponents + 1) / (4 * half)",
        "return exponents ** 2",
    ],
)
def test_other_powers_are_no_lobe_law(house, package, body):
    root = package(channel__a=LAW + "    " + body)
    assert house.lobe_laws(root) == {"torch": [], "drjit": []}


def test_lines_are_those_of_python_files(house, package):
    root = package(a="x = 1\n\ny = 2\n", cli__b="z = 3")
    (root / "text.md").write_text("one\ntwo\n")
    assert (house.lines(root), house.lines(root / "cli")) == (4, 1)


def test_the_checker_of_the_tests_counts_arrows(house, package):
    root = package(scene__a="import mitsuba\nfrom drjit import x\n", channel__a="import mitsuba\n")
    assert len(house.broken_arrows(root)) == 2


@pytest.mark.slow
def test_the_package_is_measured(house, tmp_path, capsys):
    metrics = house.measure()
    for key in house.REQUIRED:
        first, _, last = key.partition(".")
        value = metrics[first][last] if last else metrics[first]
        assert isinstance(value, int)
        counted = metrics["counted"].get(key)
        if counted is not None and key != "longest_argument_list":
            assert len(counted) == value
    assert metrics["longest_argument_list"] >= metrics["reconstruct_arguments"] > 1
    assert metrics["package_lines"] > metrics["cli_lines"] > 1_000
    # The law is somewhere, once at least in each language.
    assert min(metrics["lobe_law_copies"].values()) >= 1
    house.write(metrics, house.table(metrics).grid, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    console = Console(width=200, record=True)
    console.print(house.table(metrics).grid)
    assert f" {metrics['package_lines']} " in console.export_text()
