"""Counters of the house: words, names, sizes and import graphs, each over a folder of Python files.

Every counter returns what it counted, by name, so that a reader can check the number.
"""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

AnyFunction = ast.FunctionDef | ast.AsyncFunctionDef
QUESTION = re.compile(r"(What|Which|Where|How|Whether|Who|When|Why|Of)\b")
# Participles that do not end in -ed. Those that are imperatives, too (read, set, cut), are none.
IRREGULAR = frozenset(
    re.findall(
        r"\w+",
        """
        begun bent bound brought built caught chosen done drawn driven fed felt found frozen given
        gone grown heard held hidden kept known laid led left lit lost made met paid said seen sent
        shown sold spent spoken stood stuck swept taken taught thought thrown told torn understood
        woken won worn wound woven written
        """,
    )
)
# Words in -ed that are nouns or imperatives.
NOT_PARTICIPLES = ("embed", "exceed", "feed", "need", "proceed", "seed", "shed", "speed", "succeed")


@cache
def tree(file: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(file.read_text(encoding="utf-8"))


def code_lines(package: Path) -> int:
    """Count lines of code, imports included: no blank lines, comments or docstrings."""
    return sum(len(_lines_of_code(file)) for file in package.rglob("*.py"))


def _lines_of_code(file: Path) -> set[int]:
    text = file.read_text(encoding="utf-8")
    skipped = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
    found: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in (*skipped, tokenize.ENDMARKER):
            found |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        # Texts that stand alone: docstrings, and those below attributes.
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            found -= set(range(value.lineno, (value.end_lineno or value.lineno) + 1))
    return found


def longest_function(package: Path) -> tuple[int, str]:
    """Return the most lines of a function, from `def` to its last line, and its name."""
    return max(
        ((node.end_lineno or 0) - node.lineno + 1, f"{file.relative_to(package)}:{node.name}")
        for file in package.rglob("*.py")
        for node in ast.walk(tree(file))
        if isinstance(node, AnyFunction)
    )


def any_annotations(package: Path) -> list[str]:
    """List the `Any` in annotations of `channel/power` and `channel/rays`, the kernels."""
    found = []
    for room in ("power", "rays"):
        for file in sorted((package / "channel" / room).rglob("*.py")):
            for node in ast.walk(tree(file)):
                for annotation in _annotations(node):
                    names = [n for n in ast.walk(annotation) if isinstance(n, ast.Name)]
                    lines = [n.lineno for n in names if n.id == "Any"]
                    found += [f"{file.relative_to(package)}:{line}" for line in lines]
    return found


def _annotations(node: ast.AST) -> Iterator[ast.expr]:
    if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None:
        yield node.annotation
    if isinstance(node, AnyFunction) and node.returns is not None:
        yield node.returns


def docstrings(package: Path) -> list[tuple[str, str]]:
    """List all docstrings as (file and name, text)."""
    found = []
    for file in sorted(package.rglob("*.py")):
        for node in ast.walk(tree(file)):
            if isinstance(node, AnyFunction | ast.ClassDef | ast.Module):
                text = ast.get_docstring(node)
                if text:
                    name = getattr(node, "name", "")
                    found.append((f"{file.relative_to(package)}:{name}", text))
    return found


def question_docstrings(package: Path) -> list[str]:
    """List docstrings that open with a question word or with "Of"."""
    return [name for name, text in docstrings(package) if QUESTION.match(text)]


def duplicate_class_names(package: Path) -> list[str]:
    """List class names that more than one class has."""
    places = defaultdict(list)
    for file in sorted(package.rglob("*.py")):
        for node in ast.walk(tree(file)):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(str(file.relative_to(package)))
    return [f"{name} ({', '.join(files)})" for name, files in places.items() if len(files) > 1]


def participle_functions(package: Path) -> list[str]:
    """List functions and methods, private ones and properties too, named by a bare participle."""
    return [
        f"{file.relative_to(package)}:{node.name}"
        for file in sorted(package.rglob("*.py"))
        for node in ast.walk(tree(file))
        if isinstance(node, AnyFunction) and is_participle(node.name.strip("_"))
    ]


def is_participle(name: str) -> bool:
    """Return whether a name is one past participle, such as `joined` or `lit`."""
    regular = re.fullmatch(r"[a-z]+ed", name) and name not in NOT_PARTICIPLES
    return bool(regular) or name in IRREGULAR


def reached(package: Path, start: Path, resolve: Callable[[Path], set[Path]]) -> list[str]:
    """List the files that a file imports, directly or by way of others, itself included."""
    found, waiting = {start}, [start]
    while waiting:
        new = resolve(waiting.pop()) - found
        found |= new
        waiting += new
    return sorted(str(file.relative_to(package)) for file in found)


def fit_pipelines(package: Path) -> list[str]:
    """List files outside `inversion/` and `discovery/` that fit scenes of run files.

    Such a file calls `reconstruct` or `search` of `inversion`, or it differentiates within a loop:
    a descent of its own. Learned priors are trained, not fitted to a recording, and do not count.
    """
    found = []
    for file in sorted(package.rglob("*.py")):
        where = file.relative_to(package)
        if where.parts[0] in ("inversion", "discovery") or "shape_models" in where.parts:
            continue
        nodes = list(ast.walk(tree(file)))
        imported = {
            alias.asname or alias.name
            for node in nodes
            if isinstance(node, ast.ImportFrom) and "invertwin.inversion" in (node.module or "")
            for alias in node.names
            if alias.name in ("reconstruct", "search")
        }
        loops = [node for node in nodes if isinstance(node, ast.For | ast.While)]
        fits = bool(imported & {name for node in nodes for name in _called(node)})
        descends = any(
            name in ("backward", "autograd.grad")
            for loop in loops
            for node in ast.walk(loop)
            for name in _called(node)
        )
        if fits or descends:
            found.append(str(where))
    return found


def _called(node: ast.AST) -> Iterator[str]:
    """Yield the last name of a call, and its last two."""
    if isinstance(node, ast.Call):
        parts = ast.unparse(node.func).split(".")
        yield parts[-1]
        yield ".".join(parts[-2:])


def words(file: Path) -> int:
    """Count the words of a file, code included: runs of characters between white space."""
    return len(file.read_text(encoding="utf-8").split())
