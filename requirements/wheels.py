"""Builds the packages as wheels, in the environment of a ROS 2: ``python requirements/wheels.py DISTRIBUTION FOLDER``.

The sources name no distribution. The messages work only with the one that they were built against: the version of their
wheel has its name (0.1.0+jazzy), and the wheel requires its packages, in versions that are compatible with those of the
lock. All wheels require each other in this version. msg_agents_bringup is not among them: there are no wheels of the
``launch`` that it needs, and all that it has are launch files.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
SOURCES = ROOT / "ros_ws" / "src"
MESSAGES = "msg_agents_interfaces"
PACKAGES = (MESSAGES, "msg_analysis", "msg_agents", "msg_agents_example_protocols")
KERNEL = re.compile(r"msg_analysis/arithmetic/_kernel\.[\w.-]+\.so")
NOT_FOR_RUNS = (
    "include",
    f"share/{MESSAGES}/cmake",
    f"share/{MESSAGES}/environment",
    f"share/{MESSAGES}/local_setup.*",
    f"share/{MESSAGES}/package.dsv",
    "share/ament_index/resource_index/parent_prefix_path",
)
"""What only builds against the messages and shells that source them need: paths of this machine are in it."""
NOT_SOURCES = shutil.ignore_patterns("build", "*.egg-info", "__pycache__", "*.so", "test")
BUILD = ["--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]


def main(distribution: str, folder: str) -> None:
    """Build all wheels anew; on failure, the folder has none."""
    made = Path(folder).absolute()
    shutil.rmtree(made, ignore_errors=True)
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        for package in PACKAGES:  # copies: a folder `build` of another time would end up in the wheel
            shutil.copytree(SOURCES / package, place / package, ignore=NOT_SOURCES)
        plain = place / "plain"
        sources = [str(place / package) for package in PACKAGES]
        command = [sys.executable, "-m", "pip", "wheel", *BUILD, "--wheel-dir", str(plain), *sources]
        subprocess.run(command, env=os.environ | without_paths(), check=True)
        require_kernel(next(plain.glob("msg_analysis-*.whl")))
        finished = place / "finished"
        finished.mkdir()
        for wheel in sorted(plain.glob("*.whl")):
            complete(wheel, distribution, finished)
        for wheel in finished.glob("*.whl"):
            require_no_paths(wheel, place)
        shutil.copytree(finished, made)
    for wheel in sorted(made.glob("*.whl")):
        print(wheel.relative_to(Path.cwd()) if wheel.is_relative_to(Path.cwd()) else wheel)


def require_kernel(wheel: Path) -> None:
    """Exit with an error unless the compiled code is in the wheel: setup.py does without it if there is no compiler."""
    with zipfile.ZipFile(wheel) as archive:
        if not any(map(KERNEL.fullmatch, archive.namelist())):
            sys.exit(
                f"error: {wheel.name}: without the compiled _kernel: install a C compiler and the headers of Python"
            )


def without_paths() -> dict[str, str]:
    """Variables by which compiled code names no folders: without symbols for debuggers and places of libraries."""
    words = str(sysconfig.get_config_var("LDSHARED")).split()
    link = [word for word in words if not word.startswith(("-L", "-Wl,-rpath"))]
    flags = f"{sysconfig.get_config_var('CFLAGS')} -g0"  # what is given replaces those of Python, NDEBUG for example
    return {"CFLAGS": flags, "LDSHARED": " ".join(link)}


def require_no_paths(wheel: Path, place: Path) -> None:
    """Exit with an error if a file in the wheel names a folder of this machine, or the one in which it was built."""
    folders = [os.fsencode(folder) for folder in (ROOT, sys.prefix, place, tempfile.gettempdir() + "/tmp")]
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if any(folder in archive.read(name) for folder in folders):
                sys.exit(f"error: {wheel.name}: {name} has a path of this machine in it: see NOT_FOR_RUNS")


def complete(wheel: Path, distribution: str, made: Path) -> None:
    """Put the wheel with its whole metadata into the folder."""
    command = [sys.executable, "-m", "wheel"]
    with tempfile.TemporaryDirectory() as name:
        subprocess.run([*command, "unpack", "--dest", name, str(wheel)], check=True, stdout=subprocess.DEVNULL)
        (unpacked,) = Path(name).iterdir()
        (info,) = unpacked.glob("*.dist-info")
        package, _, version = info.name.removesuffix(".dist-info").partition("-")
        metadata = info / "METADATA"
        text = with_requirements(metadata.read_text(encoding="utf-8"), package, version, distribution)
        metadata.write_text(text, encoding="utf-8")
        if package == MESSAGES:
            data = unpacked / f"{package}-{version}.data" / "data"
            for each in [path for pattern in NOT_FOR_RUNS for path in data.glob(pattern)]:
                shutil.rmtree(each) if each.is_dir() else each.unlink()
            for each in list(unpacked.glob(f"{package}-{version}.*")):
                each.rename(each.with_name(each.name.replace(version, f"{version}+{distribution}", 1)))
        subprocess.run(
            [*command, "pack", "--dest-dir", str(made), str(unpacked)], check=True, stdout=subprocess.DEVNULL
        )


def with_requirements(metadata: str, package: str, version: str, distribution: str) -> str:
    """The text of METADATA with what the sources do not say."""
    head, blank, body = metadata.partition("\n\n")
    lines = []
    for line in head.splitlines():
        key, _, value = line.partition(": ")
        if key == "Requires-Dist" and value in PACKAGES:
            line = f"{line}=={version}"
        elif line == f"Version: {version}" and package == MESSAGES:
            line = f"{line}+{distribution}"
        lines.append(line)
    if package == MESSAGES:
        lines += [f"Requires-Dist: {each}" for each in packages_of_ros(distribution)]
    if package == "msg_agents":
        lines.append(f"Requires-Dist: {MESSAGES}=={version}")
    return "\n".join(lines) + (blank or "\n") + body


def packages_of_ros(distribution: str) -> Iterator[str]:
    """What the installed software needs of ROS 2; 7.1.6 in the lock means 7.1.6 or a later 7.1."""
    folder = HERE / distribution
    pins = dict(re.findall(r"^([\w.-]+)==([\w.]+)", (folder / "lock.txt").read_text(encoding="utf-8"), re.MULTILINE))
    for line in (folder / "runtime.in").read_text(encoding="utf-8").splitlines():
        if line.startswith(f"ros-{distribution}-"):
            yield f"{line.strip()}~={pins[line.strip()]}"


if __name__ == "__main__":
    main(*sys.argv[1:])
