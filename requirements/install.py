"""Installs the packages of a ROS 2 distribution into the environment of this Python: by uv, or by pip where uv cannot.

The argument is the name of the distribution: lock.txt in its folder has the packages. uv, several times as fast, is a
package like the others (uv.txt). It does not read pip's settings, so it gets those that say where packages are. Both
check the hash of every file, and neither writes outside of the environment. uv installs first what builds the package
of the messages (interfaces.txt), which is then built while the rest is being installed.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

HERE = Path(__file__).resolve().parent
UV = HERE / "uv.txt"
PROGRAM = Path(sysconfig.get_path("scripts")) / "uv"
INTERFACES = HERE.parent / "ros_ws" / "src" / "msg_agents_interfaces"
BUILT = Path(sys.prefix) / "built"  # folder for its wheel, which the Makefile installs
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-cache-dir"]
BY_PIP = "pip installs the packages, which takes a minute longer"
SETTINGS = {
    "index-url": ("UV_DEFAULT_INDEX", " "),
    "extra-index-url": ("UV_INDEX", " "),
    "find-links": ("UV_FIND_LINKS", ","),
    "trusted-host": ("UV_INSECURE_HOST", " "),
    "cert": ("SSL_CERT_FILE", " "),
    "timeout": ("UV_HTTP_TIMEOUT", " "),
}
"""Of pip; the variable by which uv has the same, and what stands between several values in it."""


def main(distribution: str) -> None:
    """Install; the exit code is that of the program that did it."""
    packages = HERE / distribution
    if subprocess.run([*PIP, "install", "--quiet", *hashed(UV)]).returncode:
        print(f"uv cannot be had: {BY_PIP}", file=sys.stderr)
    elif not PROGRAM.exists():
        settings = "target, prefix or root in its settings (pip config list)"
        sys.exit(f"error: pip has installed uv elsewhere than in {sys.prefix}: remove {settings}")
    elif not install_in_two_parts(packages):
        return
    else:
        print(f"uv has failed: {BY_PIP}", file=sys.stderr)
    sys.exit(install_by_pip(packages))


def hashed(file: Path) -> list[str]:
    """Options for a file of packages with their hashes."""
    return ["--require-hashes", "--requirement", str(file)]


def install_in_two_parts(packages: Path) -> int:
    """Exit code of uv."""
    cache = Path(sys.prefix) / "uv_cache"  # from where it links files to their places
    try:
        code = install_by_uv(packages / "interfaces.txt", cache)
        if code:
            return code
        # If it fails, the Makefile builds it again, and says why.
        build = [*PIP, "wheel", "--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", str(BUILT)]
        quiet = subprocess.DEVNULL
        with subprocess.Popen([*build, str(INTERFACES)], stdin=quiet, stdout=quiet, stderr=quiet):
            return install_by_uv(packages / "lock.txt", cache)
    finally:
        shutil.rmtree(cache, ignore_errors=True)


def install_by_uv(file: Path, cache: Path) -> int:
    """Its exit code; what it prints, without the names of all packages."""
    # Which of several indexes a file is from does not matter: its hash is checked.
    command = [str(PROGRAM), "pip", "install", "--python", sys.executable, "--index-strategy", "unsafe-best-match"]
    variables = {"UV_CACHE_DIR": str(cache)} | variables_of_uv() | os.environ
    with subprocess.Popen([*command, *hashed(file)], env=variables, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if not line.startswith((" + ", " - ", " ~ ")):
                print(f"  {line}", end="", file=sys.stderr)
    return process.returncode


def install_by_pip(packages: Path) -> int:
    """Its exit code; a line for every twenty packages that it looks for."""
    # All are listed. Looking for what they need, pip ignores pins of packages that others need with extras.
    lock = packages / "lock.txt"
    command = [*PIP, "install", "--no-deps", "--progress-bar", "off", *hashed(lock)]
    count, found = lock.read_text().count("=="), 0
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as pip:
        assert pip.stdout is not None
        for line in pip.stdout:
            found += line.startswith("Collecting")
            if line.startswith("Collecting") and found % 20 == 0:
                print(f"  {found} of {count} packages found", file=sys.stderr)
            elif line.startswith("Installing"):
                print("  installing them", file=sys.stderr)
    return pip.returncode


def variables_of_uv() -> dict[str, str]:
    """Where pip would look for packages."""
    listed = subprocess.run([*PIP, "config", "list"], stdout=subprocess.PIPE, text=True, check=True).stdout
    found: dict[str, str] = {}
    for wanted in ("global", "install", ":env:"):  # each over those before, as pip has it
        for line in listed.splitlines():  # global.index-url='https://...', :env:.index-url='https://...'
            name, _, value = line.partition("=")
            where, _, key = name.rpartition(".")
            if key in SETTINGS and where == wanted:
                variable, between = SETTINGS[key]
                found[variable] = between.join(word for word in str(ast.literal_eval(value)).split() if exists(word))
    return {variable: value for variable, value in found.items() if value}


def exists(place: str) -> bool:
    """False for a folder that is not there, by name or by URL: pip ignores it, uv does not."""
    parts = urlsplit(place)
    if parts.scheme == "file":
        return Path(url2pathname(parts.path)).exists()
    return not place.startswith("/") or Path(place).exists()


if __name__ == "__main__":
    main(*sys.argv[1:])
