"""Files of `experiments/cases`, which are no package, as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

CASES = Path(__file__).resolve().parents[2] / "experiments" / "cases"


def loaded(case: str, name: str) -> ModuleType:
    """A file of a case.

    Args:
        case: Its folder.
        name: Of the file, without its ending.
    """
    spec = importlib.util.spec_from_file_location(name, CASES / case / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Files of a case import one another by name; dataclasses look their module up.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
