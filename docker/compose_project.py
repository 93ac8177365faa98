"""The compose file as a project of its own: what a user has of it is not touched."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from engine import Engine

PATIENCE = 300.0  # s for all services
Rows = dict[str, dict[str, Any]]  # what compose says of each service


class Project:
    """A compose file with an engine.

    Parameters
    ----------
    found : the engine
    compose : Docker Compose, as a program
    file : the compose file
    """

    def __init__(self, found: Engine, compose: Path, file: Path) -> None:
        self.engine, self.name, self.seen_healthy = found, f"msg_agents_trial_{os.getpid()}", set[str]()
        self._command = [str(compose), "--project-name", self.name, "--file", str(file)]

    def __call__(self, *words: str) -> str:
        """Run a command of compose; what it printed on stdout."""
        return self.engine(*self._command[1:], *words, client=self._command[0])

    @contextlib.contextmanager
    def up(self, experiment: str) -> Iterator[None]:
        """All services on their way up; at the end they are removed with their network and volume."""
        environment = self.engine.environment | {"EXPERIMENT": experiment}
        self.seen_healthy.clear()
        process = subprocess.Popen(
            [*self._command, "up", "--no-build"], env=environment, stdout=sys.stderr, start_new_session=True
        )
        try:
            yield
        finally:
            self("down", "--volumes", "--timeout", "5")
            process.wait(60)

    def container(self, service: str) -> str:
        """The identifier of its container."""
        return self("ps", "--all", "--quiet", service)

    def await_healthy(self, *services: str) -> None:
        """Wait until these services have been seen healthy."""
        self._wait(lambda _rows: self.seen_healthy.issuperset(services))

    def codes(self, *services: str) -> dict[str, int]:
        """Wait for the end of these services; their exit codes."""
        rows = self._wait(lambda rows: all(rows.get(name, {}).get("State") == "exited" for name in services))
        return {name: rows[name]["ExitCode"] for name in services}

    def _wait(self, done: Callable[[Rows], bool]) -> Rows:
        deadline = time.monotonic() + PATIENCE
        while not done(rows := self._rows()):
            if time.monotonic() > deadline:
                states = {name: (row["State"], row["Health"]) for name, row in rows.items()}
                raise TimeoutError(f"services after {PATIENCE:g} s: {states}")
            time.sleep(1)
        return rows

    def _rows(self) -> Rows:
        rows = {row["Service"]: row for row in map(json.loads, self("ps", "--all", "--format", "json").splitlines())}
        self.seen_healthy |= {name for name, row in rows.items() if row["Health"] == "healthy"}
        return rows

    def run(self, image: str, command: str) -> str:
        """A command of a shell in an image with the volume of the bags; what it printed."""
        options = ["--rm", "--volume", f"{self.name}_bags:/bags", "--entrypoint", "sh"]
        return self.engine("run", *options, image, "-c", command)

    def left(self) -> list[str]:
        """What the engine still has of this project."""
        label = f"label=com.docker.compose.project={self.name}"
        kinds = (("ps", "--all"), ("network", "ls"), ("volume", "ls"))
        return [word for kind in kinds for word in self.engine(*kind, "--quiet", "--filter", label).split()]
