"""A process that has imported and compiled everything, and forks runs that tests may kill.

One JSON object per line: ``{"argv": [...], "log": path, "crash": n}`` starts
``python -m benchmarks <argv>`` in a fork and answers its process id; ``{"poll": pid}`` answers its
exit code, negative for a signal, and null while it runs. With ``crash``, the fork kills itself
before its n-th operation on files (counted from 0), and without being killed writes how many there
were to ``<log>.count``.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import traceback
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

OPERATIONS = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree"}


class FileOperations:
    """Counts operations that change files below a folder, and kills the process at one of them."""

    def __init__(self, below: str, crash: int) -> None:
        self.below, self.crash = below, crash
        self.count = 0

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, mode, flags = arguments
            writes = set("wax+") & set(mode or "") or (flags or 0) & (os.O_WRONLY | os.O_RDWR)
        elif event in OPERATIONS:
            path, writes = arguments[0], True
        else:
            return
        if writes and isinstance(path, (str, os.PathLike)) and self.below in os.fspath(path):
            if self.count == self.crash:
                os.kill(os.getpid(), signal.SIGKILL)
            self.count += 1


def run(request: dict[str, Any]) -> None:
    """In the fork: the command, and nothing of the server's after it."""
    from benchmarks.cli import main

    log = os.open(request["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a run before may have left its own
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    code = 1
    try:
        operations = None
        if "crash" in request:
            operations = FileOperations(f"{os.sep}runs{os.sep}", request["crash"])
            sys.addaudithook(operations)
        code = main(request["argv"])
        if operations is not None:
            Path(f"{request['log']}.count").write_text(str(operations.count), encoding="utf-8")
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def warm_up(preset: str, cells: list[str]) -> None:
    """Import what a run imports and compile what it compiles."""
    from benchmarks.cli import main

    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr):
        for cell in cells:
            main(["train", "--preset", preset, "--results", folder, "--cell", cell])


def main() -> None:
    preset, *cells = sys.argv[1:]
    warm_up(preset, cells)
    print("ready", flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        if "poll" in request:
            pid, status = os.waitpid(request["poll"], os.WNOHANG)
            print(os.waitstatus_to_exitcode(status) if pid else "null", flush=True)
            continue
        pid = os.fork()
        if pid == 0:
            run(request)
        print(pid, flush=True)


if __name__ == "__main__":
    main()
