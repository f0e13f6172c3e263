"""First calls of fresh processes: what Dr.Jit takes to generate and compile code."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from typing import Any


def compiled(act: Callable[[], Any]) -> tuple[Any, float]:
    """What a function returns, and the seconds of code generation and compilation in it."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        found = act()
        launched = dr.kernel_history()
    return found, sum(e.get("codegen_time", 0) + e.get("backend_time", 0) for e in launched) / 1e3


def fresh(script: str, *arguments: int) -> Any:
    """What `script --first arguments` prints as JSON in a fresh process with an empty cache."""
    command = [sys.executable, script, "--first", *map(str, arguments)]
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "DRJIT_CACHE_DIR": folder}
        found = subprocess.run(
            command, env=environment, check=True, capture_output=True, text=True
        ).stdout
    return json.loads(found)
