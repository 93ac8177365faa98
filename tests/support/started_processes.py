"""Processes that a fixture starts: none outlives its test."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def started_processes() -> Iterator[list[subprocess.Popen[str]]]:
    """A list for them; at the end, those that still run are killed, and all pipes are closed."""
    processes: list[subprocess.Popen[str]] = []
    try:
        yield processes
    finally:
        for process in processes:
            if process.poll() is None:
                process.kill()
            process.communicate()
