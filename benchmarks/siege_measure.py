"""Run a command and write its exit code, processor seconds and peak memory as JSON.

    python -I siege_measure.py RESULT SECONDS GIGABYTES COMMAND ...

The peak that Linux states for a process begins with that of the process which started it, so that
a command is started by this small one. It is killed after `SECONDS` on the clock (code 1000), or
where it holds more than `GIGABYTES` (code 1001).
"""

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path


def main() -> None:
    result, seconds, gigabytes, *command = sys.argv[1:]
    process = subprocess.Popen(command)
    code, used = _wait(process, float(seconds), float(gigabytes))
    found = [code, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9]
    Path(result).write_text(json.dumps(found))


def _wait(
    process: subprocess.Popen[bytes], seconds: float, gigabytes: float
) -> tuple[int, resource.struct_rusage]:
    """Wait for a process; kill what hangs, or takes more memory than a machine may have."""
    begun = time.monotonic()
    while True:
        number, status, used = os.wait4(process.pid, os.WNOHANG)
        late = time.monotonic() - begun > seconds
        if number:
            process.returncode = os.waitstatus_to_exitcode(status)
            return process.returncode, used
        if late or _held_gb(process.pid) > gigabytes:
            process.kill()
            _, process.returncode, used = os.wait4(process.pid, 0)
            return 1000 if late else 1001, used
        time.sleep(0.05)


def _held_gb(number: int) -> float:
    try:
        pages = int(Path(f"/proc/{number}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * resource.getpagesize() / 1e9


if __name__ == "__main__":
    main()
