"""Try the image and the compose file with a container engine; where none can run, without one (rehearse.py).

With an engine that runs, or with Debian's, started for the trial (engine.py), the image is built; the services of
compose.yaml come up as documented; a container of agents is killed, and the recorder stopped, in runs of their own; and
single containers run as another user, without a home, on a read-only root. Whatever comes of it, the containers,
networks and volumes of the trial are removed; the image stays. The exit code is 1 if anything was not as it should be.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from compose_project import Project
from engine import Engine, engine
from image import base_system, build_options

HERE = Path(__file__).resolve().parent
BASE, IMAGE = "msg-agents-base", "msg-agents"
NODES = ("recorder", "switcher", "agents_1_to_2", "agents_3_to_5")
BAG = "/bags/$(cat /bags/.run/name)"
READ_ONLY, FOREIGN_USER = ("--read-only", "--tmpfs", "/tmp"), ("--user", "1234:1234")
SINGLE = {
    "read-only root": READ_ONLY,
    "read-only root without /tmp": READ_ONLY[:1],
    "another user": FOREIGN_USER,
    "another user without a home on a read-only root": (*FOREIGN_USER, "--env", "HOME=", *READ_ONLY),
}
"""Options of ``docker run``, each for a run in one container."""


class Findings:
    """What was as it should be, and what was not."""

    def __init__(self) -> None:
        self.failed = False

    def expect(self, subject: str, found: Any, wanted: Any) -> None:
        """Say whether what was found is what was wanted."""
        self.failed |= found != wanted
        print(f"ok      {subject}" if found == wanted else f"FAILED  {subject}: {found}, expected {wanted}", flush=True)


def build(found: Engine, folder: Path, base: str | None) -> None:
    """The image; its base is a fresh Debian unless one is given."""
    if base is None:
        with subprocess.Popen(["tar", "-C", str(base_system(folder)), "-c", "."], stdout=subprocess.PIPE) as archive:
            found("import", "-", BASE, stdin=archive.stdout)
    found.build(*build_options(base or BASE), "--tag", IMAGE, HERE.parent)


def demonstration(project: Project, findings: Findings) -> None:
    """The services as documented."""
    with project.up("line_ring"):
        codes = project.codes("prepare", *NODES, "verdict")
        findings.expect("compose up: exit codes", set(codes.values()), {0})
        verdict = project("logs", "--no-log-prefix", "verdict")
        findings.expect("compose up: equal to the twin", "equal to the twin" in verdict, True)
        findings.expect("compose up: verdict", "agrees" in verdict, True)


def fault(project: Project, findings: Findings, command: str, service: str, wanted: dict[str, int]) -> None:
    """A container of a run in real time is killed or stopped; the others end by themselves, and the bag can be read."""
    with project.up("line_ring_realtime"):
        project.await_healthy(*NODES)  # in lockstep the run may end before the engine has looked
        findings.expect(f"docker {command} {service}: seen healthy", sorted(project.seen_healthy), sorted(NODES))
        project.engine(command, project.container(service))
        findings.expect(f"docker {command} {service}: exit codes", project.codes(*NODES), wanted)
        info = json.loads(project.run(IMAGE, f'msg-analysis info "{BAG}" --json'))
        states = (info["problem"], info["completeness"]["received"] > 0, info["completeness"]["complete"])
        findings.expect(f"docker {command} {service}: bag", states, (None, True, False))


def single_containers(found: Engine, findings: Findings) -> None:
    """A run in one container, in different surroundings."""
    command = ["run", "line_ring", "--out", "/runs", "--duration", "100", "--json"]
    for name, options in SINGLE.items():
        words = ("run", "--rm", "--init", "--tmpfs", "/runs:mode=1777", *options, IMAGE, *command)
        result = json.loads(found(*words, check=False) or "{}")
        findings.expect(f"docker run, {name}: verdict", result.get("verdict"), "agrees")


def main() -> None:
    """See the text of this module."""
    parser = argparse.ArgumentParser(description="Try the image and the compose file.")
    parser.add_argument("--folder", type=Path, default=HERE.parent / "build/container", help="for all that is made")
    parser.add_argument("--base", help="image to build on, if a registry is within reach; default: a fresh Debian")
    parser.add_argument("--no-build", action="store_true", help="the image is there already")
    parser.add_argument("--compose", type=Path, required=True, help="Docker Compose, 2 or newer, as a program")
    options = parser.parse_args()
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    findings = Findings()
    with engine(folder) as found:
        if found is not None:
            if not options.no_build:
                build(found, folder, options.base)
            project = Project(found, options.compose, HERE / "compose.yaml")
            single_containers(found, findings)
            demonstration(project, findings)
            fault(project, findings, "kill", "agents_1_to_2", dict(zip(NODES, (2, 2, 137, 2), strict=True)))
            fault(project, findings, "stop", "recorder", dict(zip(NODES, (3, 2, 2, 2), strict=True)))
            findings.expect("containers, networks, volumes that are left", project.left(), [])
    if found is None:
        words = ["--folder", str(folder), *(["--base", options.base] if options.base else [])]
        words += ["--no-build"] if options.no_build else []
        sys.exit(subprocess.call([sys.executable, str(HERE / "rehearse.py"), *words]))
    sys.exit(int(findings.failed))


if __name__ == "__main__":
    try:
        main()
    except (subprocess.CalledProcessError, TimeoutError) as error:
        sys.exit(f"error: {error}")
