"""Build the image and run the compose file without a container engine.

Needs root, and from Debian buildah, debootstrap, iproute2 and util-linux.

The image is built from docker/Dockerfile, step by step in a chroot (``buildah --isolation chroot``), by default on a
fresh Debian with Python (debootstrap), since a registry of images may not be within reach. Then every service of
docker/compose.yaml runs in that image's root file system: in a mount namespace, in a network namespace on a bridge, as
the image's user, without capabilities, on a read-only root with its tmpfs and its volume, in the order of
``depends_on``, with its health check. What an engine would do besides (cgroups, seccomp, DNS, restarts) is not
rehearsed.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml
from image import base_system, build_options

HERE = Path(__file__).resolve().parent
BASE, IMAGE = "localhost/msg-agents-base", "localhost/msg-agents"
PATIENCE = 300.0  # s for a service


def run(*words: str | Path, **options: Any) -> str:
    """Run a command; what it printed."""
    done = subprocess.run([str(word) for word in words], check=True, stdout=subprocess.PIPE, text=True, **options)
    return str(done.stdout).strip()


class Buildah:
    """Buildah with a storage of our own."""

    def __init__(self, folder: Path) -> None:
        self._words: list[str | Path] = ["buildah", "--root", folder / "storage", "--runroot", folder / "runroot"]
        self._words += ["--storage-driver", "vfs"]

    def __call__(self, *words: str | Path) -> str:
        """Run a command of buildah; what it printed."""
        return run(*self._words, *words)

    def base(self, folder: Path) -> str:
        """A Debian with Python as an image."""
        container = self("from", "scratch")
        run("cp", "--archive", f"{base_system(folder)}/.", self("mount", container))
        self("commit", "--rm", container, BASE)
        return BASE

    def build(self, base: str) -> None:
        """The Dockerfile, on a base."""
        self("bud", "--isolation", "chroot", "--format", "docker", *build_options(base), "--tag", IMAGE, HERE.parent)


def interpolated(text: str) -> str:
    """A text of the compose file as the engine reads it: variables from our environment, ``$$`` for ``$``."""

    def value(found: re.Match[str]) -> str:
        return "$" if found[0] == "$$" else os.environ.get(found[1], "") or found[2] or ""

    return re.sub(r"\$\$|\$\{(\w+)(?::-([^}]*))?\}", value, text)


class Services:
    """The services of a compose file on the root file system of an image.

    Parameters
    ----------
    root : of the image
    config : of the image
    document : the compose file
    bags : directory that stands for the volume
    """

    def __init__(self, root: Path, config: dict[str, Any], document: dict[str, Any], bags: Path) -> None:
        self._root, self._config, self._bags = root, config, bags
        self._specs: dict[str, Any] = document["services"]
        self._prefix = f"msgc{os.getpid()}_"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def lan(self) -> None:
        """A network namespace for each service, on a bridge in one more."""
        run("ip", "netns", "add", self._prefix + "lan")
        switch = ("ip", "-n", self._prefix + "lan", "link")
        run(*switch, "add", "bridge", "type", "bridge")
        run(*switch, "set", "bridge", "up")
        for number, name in enumerate(self._specs, start=1):
            space, port = self._prefix + name, f"port{number}"
            run("ip", "netns", "add", space)
            run(*switch, "add", port, "type", "veth", "peer", "name", "eth0", "netns", space)
            run(*switch, "set", port, "master", "bridge", "up")
            run("ip", "-n", space, "address", "add", f"10.78.0.{number}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                run("ip", "-n", space, "link", "set", device, "up")
            run("ip", "-n", space, "route", "add", "default", "dev", "eth0")  # multicast needs a route

    def start(self, name: str) -> None:
        """Start a service as the image's user in its namespaces."""
        spec = self._specs[name]
        environment = dict(pair.split("=", 1) for pair in self._config["Env"])
        environment |= {key: interpolated(str(value)) for key, value in spec["environment"].items()}
        mounts = [
            f"mount --rbind {self._root} {self._root}",
            f"mount --bind {self._bags} {self._root}/bags",
            *(f"mount -t tmpfs tmpfs {self._root}{path}" for path in spec["tmpfs"]),
            f"mount -t proc proc {self._root}/proc",
            f"mount --rbind /dev {self._root}/dev",
            f"mount -t tmpfs tmpfs {self._root}/dev/shm",
        ]
        if spec.get("read_only"):
            mounts.append(f"mount -o remount,bind,ro {self._root}")
        user = self._config["User"]
        enter = (
            f"exec chroot {self._root} setpriv --reuid {user} --regid {user} --clear-groups --bounding-set -all "
            f'--no-new-privs -- "$@"'
        )
        command = [interpolated(word) for word in (*spec["entrypoint"], *spec["command"])]
        self.processes[name] = subprocess.Popen(
            ["ip", "netns", "exec", self._prefix + name, "unshare", "--mount", "--propagation", "private",
             "/bin/sh", "-ec", "; ".join((*mounts, f"cd {self._root}", enter)), name, *command],
            env=environment | {"HOME": self._home(user)},
        )  # fmt: skip

    def _home(self, user: str) -> str:
        """The home of a user of the image, as an engine sets it: / if there is none."""
        accounts = (line.split(":") for line in (self._root / "etc/passwd").read_text(encoding="utf-8").splitlines())
        return next((account[5] for account in accounts if account[2] == user), "/")

    def healthy(self, name: str) -> bool:
        """Whether the health check of a running service passes."""
        _, test = self._specs[name]["healthcheck"]["test"]
        enter = ["nsenter", "--target", str(self.processes[name].pid), "--mount", "chroot", str(self._root)]
        return subprocess.run([*enter, "/bin/sh", "-c", interpolated(test)]).returncode == 0

    def up(self) -> dict[str, int]:
        """Run all; their exit codes."""
        self.lan()
        waiting, sick = list(self._specs), {name for name, spec in self._specs.items() if "healthcheck" in spec}
        deadline = time.monotonic() + PATIENCE
        while waiting or any(process.poll() is None for process in self.processes.values()):
            if time.monotonic() > deadline:
                raise TimeoutError(f"not all services were done within {PATIENCE:g} s")
            codes = {name: process.poll() for name, process in self.processes.items()}
            for name in list(waiting):
                needed = [codes.get(other) for other in self._specs[name].get("depends_on", {})]
                if any(code not in (None, 0) for code in needed):
                    raise RuntimeError(f"{name}: what it depends on has failed")
                if all(code == 0 for code in needed):
                    waiting.remove(name)
                    self.start(name)
            sick -= {name for name in sick if codes.get(name, 0) is None and self.healthy(name)}
            time.sleep(0.5)
        if sick:
            raise RuntimeError(f"never seen healthy: {', '.join(sorted(sick))}")
        return {name: process.returncode for name, process in self.processes.items()}

    def down(self) -> None:
        """End what runs, and remove the network."""
        for process in self.processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        for name in ("lan", *self._specs):
            subprocess.run(["ip", "netns", "delete", self._prefix + name], stderr=subprocess.DEVNULL)


def main() -> None:
    """See the text of this module."""
    parser = argparse.ArgumentParser(description="Build the image and run the compose file without an engine.")
    parser.add_argument("--folder", type=Path, default=HERE.parent / "build/container", help="for all that is made")
    parser.add_argument("--base", help="image to build on, if a registry is within reach; default: a fresh Debian")
    parser.add_argument("--no-build", action="store_true", help="the image is there already")
    options = parser.parse_args()
    if os.geteuid() != 0:
        sys.exit("error: mounts and namespaces need root")
    missing = [tool for tool in ("buildah", "debootstrap", "ip", "unshare", "nsenter") if shutil.which(tool) is None]
    if missing:
        sys.exit(f"error: not found: {', '.join(missing)}: apt-get install buildah debootstrap iproute2 util-linux")
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    buildah = Buildah(folder)
    if not options.no_build:
        buildah.build(options.base or buildah.base(folder))
    container = buildah("from", IMAGE)
    config = json.loads(buildah("inspect", "--type", "image", IMAGE))["Docker"]["config"]
    with tempfile.TemporaryDirectory(prefix="msg_agents_volume_") as volume:
        bags = Path(volume)
        os.chown(bags, int(config["User"]), int(config["User"]))
        document = yaml.safe_load((HERE / "compose.yaml").read_text(encoding="utf-8"))
        services = Services(Path(buildah("mount", container)), config, document, bags)
        try:
            codes = services.up()
        finally:
            services.down()
            buildah("rm", container)
        print(" ".join(f"{name}: {code}" for name, code in codes.items()))
        sys.exit(max(codes.values()))


if __name__ == "__main__":
    main()
