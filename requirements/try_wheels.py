"""Installs the wheels in a folder as a user would, where there is no compiler, and uses them.

In a new environment, from an empty folder, without HOME: ``pip install``, the demo network to its verdict, the check
against the twin, and the check again without the compiled code.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

LEFT_OUT = ("HOME", "PATH", "VIRTUAL_ENV", "CC", "CXX", "ROS", "AMENT", "PYTHON", "MAKE")
"""Beginnings of names of variables that a clean machine does not have; those of pip say where packages are."""
COMPILERS = ("cc", "gcc", "g++", "c++", "clang", "make", "cmake")


class Machine:
    """A new environment, its programs the only ones on the path, and an empty folder to work in."""

    def __init__(self, place: Path) -> None:
        subprocess.run([sys.executable, "-m", "venv", str(place / "environment")], check=True)
        self.bin = place / "environment" / "bin"
        self.folder = place / "empty"
        self.folder.mkdir()
        self.variables = {name: value for name, value in os.environ.items() if not name.startswith(LEFT_OUT)}
        self.variables["PATH"] = str(self.bin)
        found = [name for name in COMPILERS if (self.bin / name).exists()]
        assert not found, found

    def __call__(self, program: str, *words: str) -> str:
        """Run one of the programs; what it printed on stdout. CalledProcessError: it failed."""
        command = [str(self.bin / program), *words]
        return subprocess.run(
            command,
            cwd=self.folder,
            env=self.variables,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        ).stdout

    def document(self, program: str, *words: str) -> Any:
        """The JSON that it printed."""
        return json.loads(self(program, *words, "--json"))


def main(folder: str) -> None:
    """Try all; an AssertionError or CalledProcessError ends it."""
    wheels = sorted(str(wheel.absolute()) for wheel in Path(folder).glob("*.whl"))
    assert wheels, f"{folder}: no wheels: make wheels"
    with tempfile.TemporaryDirectory() as name:
        machine = Machine(Path(name))
        began, cpu = time.monotonic(), cpu_time()
        machine("pip", "install", "--quiet", "--disable-pip-version-check", *wheels)
        installed = time.monotonic()
        demo = machine.document("msg-agents", "demo", "--duration", "100")
        ended = time.monotonic()
        assert demo["verdict"] == "agrees", demo["verdict"]
        assert demo["failures"] == [], demo["failures"]
        print(
            f"pip install to verdict: {ended - began:.0f} s, of which pip {installed - began:.0f} s; "
            f"CPU time {cpu_time() - cpu:.0f} s; other work on this machine: load {os.getloadavg()[0]:.0f}"
        )
        machine("pip", "check")
        assert_equal(machine)
        kernels = list(machine.bin.parent.glob("lib/python*/site-packages/msg_analysis/arithmetic/_kernel.*.so"))
        assert len(kernels) == 1, kernels
        kernels[0].unlink()
        assert_equal(machine)
        use(machine)
    print("agrees; equal to the twin to the last bit, with and without the compiled code")


def cpu_time() -> float:
    """Of all processes that have been started and have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def assert_equal(machine: Machine) -> None:
    """The newest run has all states, and the twin has the same."""
    check = machine.document("msg-agents", "check")
    assert (check["equal"], check["missing"]) == (True, 0), check


def use(machine: Machine) -> None:
    """Examples by name, a new file, a protocol of the package of examples."""
    names = [each["name"] for each in machine.document("msg-agents", "examples")["examples"]]
    assert "line_ring" in names, names
    assert machine.document("msg-analysis", "predict", "line_ring")["emulated"]["system_error"] > 0
    machine("msg-agents", "new", "lab.yaml")
    assert machine.document("msg-analysis", "info", "lab.yaml")["name"] == "lab"
    share = machine.bin.parent / "share" / "msg_agents_example_protocols" / "experiments"
    assert machine.document("msg-analysis", "info", str(share / "metropolis.yaml"))["protocol"]["absent"] is None


if __name__ == "__main__":
    main(*sys.argv[1:])
