"""The shape of the code: import arrows, sizes, names, words, relayed options, copies of a law.

    python benchmarks/house.py [-o DIR]

Prints a table and writes `metrics.json` into DIR (default `out/house`). Everything is read from
`src/invertwin`, most of it from its syntax trees, and from README.md and docs/limitations.md. What
must hold is tested by `tests/test_house.py`, which `make check` runs; a value that is not reached
yet (`REACHED`) may not grow.

- `circles`: cycles of imports between files; menus (`__init__.py`) count as files. `arrows_up`:
  imports against the order of rooms, and of folders inside rooms. `own_imports_by_string`: calls of
  `import_module` with a name of the package. All three as `tests/test_architecture.py` finds them.
- `files_reached_by_reconstruct`: files that `inversion/reconstruction.py` imports, directly or by
  way of others; a name taken from a menu leads to the file that defines it.
- `code_lines`: lines of the package without blank lines, comments and docstrings.
- `fit_pipelines`, `any_in_kernels`, `longest_function_lines`, `question_docstrings` (a share of all
  docstrings), `duplicate_class_names`, `participle_functions`, `readme_words`, `limitations_words`:
  see `house_counts.py`.
- `reconstruct_arguments`: parameters of `invertwin.reconstruct`.
- `longest_argument_list`: most parameters of a public function, or of a public method or
  constructor that is a function. Public means that no name on the way begins with an underscore,
  `__init__`, `__new__` and `__call__` excepted. `self` and `cls` do not count; `*args` and
  `**kwargs` count one each. The fields of dataclasses and of pydantic tables do not count: they are
  values with names, and nobody writes their constructors.
- `cli_lines`, `package_lines`: lines of all `.py` files below `cli/`, and of the whole package.
- `hops_boundary_samples`: functions that merely pass the option on. Such a function reads a name or
  an attribute `boundary_samples` only to make it an argument of the same name: by keyword, by its
  position in a call of a function or class of the package, or as an entry of a dictionary.
- `lobe_law_copies`: functions in `channel/` and `peers/` that raise a value to the exponent of a
  lobe, ((1 + cos ψ)/2)^α: by `**`, by `pow` or `power`, or by exp(α · log …). An exponent is a
  value whose expression mentions a name with `exponent` in it, also by way of local variables. A
  function that names `dr` counts for Dr.Jit, any other for torch.
- `import_arrow_exceptions`: imports that break a rule of `tests/test_architecture.py` (needs
  pytest).
"""

import argparse
import ast
import importlib.util
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import house_counts as counts
from report import MetricTable, Required, write

import invertwin

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "invertwin"
OPTION = "boundary_samples"
CONSTRUCTORS = ("__init__", "__new__", "__call__")
POWERS = ("pow", "power", "float_power")
LOGARITHMS = ("log", "log1p", "log_one_minus")  # the last is log(1 - x), of our own
REQUIRED: Required = {
    "circles": ("<=", 0),
    "arrows_up": ("<=", 0),
    "own_imports_by_string": ("<=", 0),
    "files_reached_by_reconstruct": ("<=", 60),
    "code_lines": ("<=", 39_000),
    "fit_pipelines": ("<=", 1),
    "longest_function_lines": ("<=", 80),
    "any_in_kernels": ("<=", 60),
    "question_docstrings": ("<=", 0.01),
    "duplicate_class_names": ("<=", 0),
    "participle_functions": ("<=", 0),
    "readme_words": ("<=", 1_000),
    "limitations_words": ("<=", 2_500),
    "reconstruct_arguments": ("<=", 9),
    "longest_argument_list": ("<=", 10),
    "hops_boundary_samples": ("<=", 3),
    "lobe_law_copies.torch": ("<=", 1),
    "lobe_law_copies.drjit": ("<=", 1),
    "import_arrow_exceptions": ("<=", 0),
}
# What is required, but not reached yet, and the value that must not grow: lower it with every
# change that lowers the value, and drop the row where the requirement holds.
REACHED: dict[str, float] = {
    "code_lines": 42_947,
}

AnyFunction = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Function:
    """A function of the package.

    Attributes:
        name: file and dotted name, for people.
        node: its definition.
        public: whether a user may call it.
        method: whether its first parameter is the object or its class.
    """

    name: str
    node: AnyFunction
    public: bool
    method: bool

    @property
    def parameters(self) -> list[str]:
        """Names of all parameters but `self` and `cls`."""
        given = self.node.args
        names = [one.arg for one in (*given.posonlyargs, *given.args)][self.method :]
        rest = [one for one in (given.vararg, *given.kwonlyargs, given.kwarg) if one is not None]
        return [*names, *(one.arg for one in rest)]


def functions(package: Path) -> Iterator[Function]:
    """All functions of a package, those within functions too, which are not public."""
    for file in sorted(package.rglob("*.py")):
        where = file.relative_to(package)
        public = not any(_hidden(part.removesuffix(".py")) for part in where.parts)
        yield from _below(counts.tree(file), str(where), public, in_class=False)


def _below(node: ast.AST, name: str, public: bool, in_class: bool) -> Iterator[Function]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, AnyFunction):
            shown = public and not _hidden(child.name)
            static = any(ast.unparse(d) == "staticmethod" for d in child.decorator_list)
            dotted = f"{name}:{child.name}" if name.endswith(".py") else f"{name}.{child.name}"
            yield Function(dotted, child, shown, in_class and not static)
            yield from _below(child, dotted, False, in_class=False)
        elif isinstance(child, ast.ClassDef):
            dotted = f"{name}:{child.name}" if name.endswith(".py") else f"{name}.{child.name}"
            yield from _below(child, dotted, public and not _hidden(child.name), in_class=True)
        else:
            yield from _below(child, name, public, in_class)


def _hidden(name: str) -> bool:
    return name.startswith("_") and name not in (*CONSTRUCTORS, "__init__")


def longest_argument_list(package: Path) -> tuple[int, str]:
    """The most parameters of a public function, and its name."""
    return max((len(one.parameters), one.name) for one in functions(package) if one.public)


def lines(folder: Path) -> int:
    """Lines of all Python files below a folder."""
    files = folder.rglob("*.py")
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def relays(package: Path, option: str = OPTION) -> list[str]:
    """Functions that do nothing with an option but pass it on as an argument of the same name."""
    places = _places(package, option)
    return [one.name for one in functions(package) if _only_passed_on(one.node, option, places)]


def _places(package: Path, option: str) -> dict[str, int]:
    """Where a call that names no keyword puts the option: by name of function or class."""
    places = {}
    for one in functions(package):
        if option in one.parameters:
            owner, _, name = one.name.replace(":", ".").rpartition(".")
            callee = owner.rpartition(".")[2] if name in CONSTRUCTORS else name
            places[callee] = one.parameters.index(option)
    for file in package.rglob("*.py"):
        for node in ast.walk(counts.tree(file)):
            if isinstance(node, ast.ClassDef):
                fields = [ast.unparse(f.target) for f in node.body if isinstance(f, ast.AnnAssign)]
                if option in fields:
                    places.setdefault(node.name, fields.index(option))
    return places


def _only_passed_on(function: AnyFunction, option: str, places: dict[str, int]) -> bool:
    uses, passed = [], []
    for node in _own(function):
        if option in (getattr(node, "id", None), getattr(node, "attr", None)):
            uses.append(node)
        if isinstance(node, ast.Dict):
            entries = zip(node.keys, node.values, strict=True)
            passed += [value for key, value in entries if getattr(key, "value", None) == option]
        if isinstance(node, ast.Call):
            passed += [word.value for word in node.keywords if word.arg == option]
            place = places.get(ast.unparse(node.func).rpartition(".")[2])
            if place is not None and place < len(node.args):
                passed.append(node.args[place])
    return bool(uses) and all(any(use is value for value in passed) for use in uses)


def lobe_laws(package: Path) -> dict[str, list[str]]:
    """By language, the functions that raise something to the exponent of a lobe."""
    found: dict[str, list[str]] = {"torch": [], "drjit": []}
    for one in functions(package):
        if one.name.split("/")[0] in ("channel", "peers") and _raises_to_exponent(one.node):
            names = {node.id for node in ast.walk(one.node) if isinstance(node, ast.Name)}
            found["drjit" if "dr" in names else "torch"].append(one.name)
    return found


def _raises_to_exponent(function: AnyFunction) -> bool:
    own = list(_own(function))
    known: set[str] = set()

    def is_exponent(value: ast.AST) -> bool:
        words = {n.id for n in ast.walk(value) if isinstance(n, ast.Name)}
        attributes = {n.attr for n in ast.walk(value) if isinstance(n, ast.Attribute)}
        return bool(words & known) or any("exponent" in word for word in words | attributes)

    # A local variable that holds an exponent is one, whatever its name.
    for node in own:
        if isinstance(node, ast.Assign) and is_exponent(node.value):
            known |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return any(is_exponent(exponent) for node in own for exponent in _exponents_of_powers(node))


def _own(function: AnyFunction) -> Iterator[ast.AST]:
    """The nodes of a function without those of functions within it, in the order of the text."""
    for child in ast.iter_child_nodes(function):
        if not isinstance(child, AnyFunction):
            yield child
            yield from _own(child)  # pyright: ignore[reportArgumentType]


def _exponents_of_powers(node: ast.AST) -> Iterator[ast.AST]:
    """What a value is raised to, where the node is a power."""
    if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.Pow):
        yield node.right if isinstance(node, ast.BinOp) else node.value
    if isinstance(node, ast.Call):
        name = ast.unparse(node.func).rpartition(".")[2]
        if name in POWERS and node.args:
            yield node.args[-1]
        if name == "exp" and node.args and isinstance(node.args[0], ast.BinOp):
            product = node.args[0]
            logarithms = [_is_logarithm(side) for side in (product.left, product.right)]
            if isinstance(product.op, ast.Mult) and any(logarithms):
                yield product.left if logarithms[1] else product.right


def _is_logarithm(value: ast.AST) -> bool:
    calls = [node for node in ast.walk(value) if isinstance(node, ast.Call)]
    return any(ast.unparse(call.func).rpartition(".")[2] in LOGARITHMS for call in calls)


def checker_of_tests() -> Any:
    """Return the module that checks the imports for the tests."""
    spec = importlib.util.spec_from_file_location(
        "test_architecture", ROOT / "tests" / "test_architecture.py"
    )
    assert spec is not None
    assert spec.loader is not None
    checker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(checker)
    return checker


def broken_arrows(package: Path) -> list[str]:
    """List what the checker of the tests says about the imports."""
    return checker_of_tests().violations(package)


def files_reached(package: Path, start: str) -> list[str]:
    """List the files that a file of the package imports, by way of others too."""
    checker = checker_of_tests()

    def defining(name: str) -> Path | None:
        """Return the file that defines a name, through menus."""
        file = checker.module_of(name, package)
        while file is not None and file.name == "__init__.py":
            wanted = name.rpartition(".")[2]
            offered = {full.rpartition(".")[2]: full for _, full in checker.imports(file, package)}
            if wanted not in offered:
                return file
            name = offered[wanted]
            file = checker.module_of(name, package)
        return file

    def imported(file: Path) -> set[Path]:
        found = {defining(name) for _, name in checker.imports(file, package)}
        return {target for target in found if target is not None} - {file}

    return counts.reached(package, package / start, imported)


def measure(package: Path = PACKAGE) -> dict[str, Any]:
    """Measure all metrics, and list by name what was counted."""
    broken = broken_arrows(package)
    laws = lobe_laws(package)
    asked = counts.question_docstrings(package)
    listed = {
        "circles": [line for line in broken if line.startswith("cycle: ")],
        "arrows_up": [line for line in broken if "must not import" in line],
        "own_imports_by_string": [line for line in broken if "import by a string" in line],
        "files_reached_by_reconstruct": files_reached(package, "inversion/reconstruction.py"),
        "fit_pipelines": counts.fit_pipelines(package),
        "any_in_kernels": counts.any_annotations(package),
        "duplicate_class_names": counts.duplicate_class_names(package),
        "participle_functions": counts.participle_functions(package),
        "hops_boundary_samples": relays(package),
        "import_arrow_exceptions": broken,
    }
    arguments, wide = longest_argument_list(package)
    length, long = counts.longest_function(package)
    return {
        **{key: len(names) for key, names in listed.items()},
        "reconstruct_arguments": len(inspect.signature(invertwin.reconstruct).parameters),
        "longest_argument_list": arguments,
        "longest_function_lines": length,
        "question_docstrings": len(asked) / len(counts.docstrings(package)),
        "code_lines": counts.code_lines(package),
        "cli_lines": lines(package / "cli"),
        "package_lines": lines(package),
        "readme_words": counts.words(ROOT / "README.md"),
        "limitations_words": counts.words(ROOT / "docs" / "limitations.md"),
        "lobe_law_copies": {language: len(names) for language, names in laws.items()},
        "counted": {
            **listed,
            "question_docstrings": asked,
            "longest_argument_list": [wide],
            "longest_function_lines": [long],
            "lobe_law_copies.torch": laws["torch"],
            "lobe_law_copies.drjit": laws["drjit"],
        },
    }


def table(metrics: dict[str, Any]) -> MetricTable:
    """Return a table with a row a metric."""
    shown = MetricTable("The shape of the code", REQUIRED)
    for key in ("cli_lines", "package_lines", *REQUIRED):
        first, _, last = key.partition(".")
        value = metrics[first][last] if last else metrics[first]
        names = metrics["counted"].get(key, [])
        text = ", ".join(names[:3]) + (f", and {len(names) - 3} more" if len(names) > 3 else "")
        shown.row(key, value, ".4f" if isinstance(value, float) else "d", text)
    return shown


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/house"))
    given = parser.parse_args()
    metrics = measure()
    write(metrics, table(metrics).grid, given.out)


if __name__ == "__main__":
    main()
