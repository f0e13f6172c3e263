"""The benchmark of the code's shape: what it counts in small packages, and that it reads ours."""

import json

import pytest
from rich.console import Console


@pytest.fixture
def counts(house):
    """The counters that the benchmark calls."""
    return house.counts


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
    root = package(channel__a=code.format("one", "dr.log") + code.format("two", "log_one_minus"))
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


def test_code_is_counted_without_blanks_comments_and_docstrings(counts, package):
    root = package(
        a='"""Module.\n\nMore.\n"""\n\nimport math  # why\n\n\ndef f():\n    """Text."""\n'
        '    # a comment\n    return """two\nlines"""\n\n\nX = 1\n"""About X."""\n'
    )
    assert counts.code_lines(root) == 5


def test_the_longest_function_is_found_within_classes(counts, package):
    root = package(
        a="class A:\n    def f(self):\n        x = 1\n\n        return x\n\ndef g(): pass\n"
    )
    assert counts.longest_function(root) == (4, "a.py:f")


def test_any_counts_in_every_annotation_of_kernels_and_nowhere_else(counts, package):
    source = "from typing import Any\nx: Any = 1\ndef f(a: list[Any], b: int) -> Any: return Any\n"
    root = package(channel__power__a=source, channel__em__a=source)
    assert counts.any_annotations(root) == [
        "channel/power/a.py:2",
        "channel/power/a.py:3",
        "channel/power/a.py:3",
    ]


@pytest.mark.parametrize(
    ("text", "asks"),
    [
        ("What a face makes of waves.", True),
        ("Of the points.", True),
        ("Whether it is lit.", True),
        ("Offset of a point.", False),
        ("Return what is left.", False),
        ("Howitzer.", False),
    ],
)
def test_a_docstring_that_opens_with_a_question_word_is_found(counts, package, text, asks):
    root = package(a=f'def f():\n    """{text}"""\n')
    assert counts.question_docstrings(root) == (["a.py:f"] if asks else [])


def test_class_names_are_compared_across_files(counts, package):
    root = package(a="class Stage: pass\nclass One: pass\n", b__c="class Stage: pass\n")
    assert counts.duplicate_class_names(root) == ["Stage (a.py, b/c.py)"]


@pytest.mark.parametrize(
    ("name", "bare"),
    [
        ("joined", True),
        ("_lit", True),
        ("told", True),
        ("feed", False),
        ("seed", False),
        ("read", False),
        ("join_paths", False),
        ("checked_tensor", False),
    ],
)
def test_bare_participles_are_found(counts, package, name, bare):
    root = package(a=f"class A:\n    def {name}(self): pass\n")
    assert counts.participle_functions(root) == ([f"a.py:{name}"] if bare else [])


def test_files_are_reached_through_the_menu_that_names_them(house, package):
    root = package(
        top="from package.room import used\n",
        room__a="import math\nfrom package.base import y\nused = 1\n",
        room__b="x = 1\n",
        base="y = 1\n",
    )
    menu = "from package.room.a import used as used\nfrom package.room.b import x as x\n"
    (root / "room" / "__init__.py").write_text(menu)
    assert house.files_reached(root, "top.py") == ["base.py", "room/a.py", "top.py"]


def test_a_second_way_to_fit_is_found(counts, package):
    descent = "def f(x):\n    for _ in range(9):\n        x.loss().backward()\n"
    call = "from invertwin.inversion import reconstruct\ndef f(): reconstruct()\n"
    root = package(
        cli__fits__one=call,
        cli__text="import re\ndef f(): re.search('a', 'b')\n",
        links__panel=descent,
        inversion__fit=descent,
        scene__shape_models__prior=descent,
    )
    assert counts.fit_pipelines(root) == ["cli/fits/one.py", "links/panel.py"]


def test_the_checker_of_the_tests_counts_arrows(house, package):
    root = package(scene__a="import mitsuba\nfrom drjit import x\n", channel__a="import mitsuba\n")
    assert len(house.broken_arrows(root)) == 2


@pytest.mark.slow
def test_the_package_is_measured(house, tmp_path, capsys):
    metrics = house.measure()
    for key in house.REQUIRED:
        first, _, last = key.partition(".")
        value = metrics[first][last] if last else metrics[first]
        counted = metrics["counted"].get(key)
        if counted is not None and not key.startswith(("longest_", "question_")):
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
