"""The ROS packages as tools of ROS read them: what they depend on, and what a release of them needs."""

import re
import runpy
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
import setuptools
import yaml

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(file.parent for file in (ROOT / "ros_ws/src").glob("*/package.xml"))
KEYS = yaml.safe_load((ROOT / "tests/data/rosdep_keys.yaml").read_text())["keys"]
LICENCE = "# SPDX-FileCopyrightText: 2026 msg_agents contributors\n# SPDX-License-Identifier: Apache-2.0\n"
OF_PYTHON = {"python3-yaml": "pyyaml"}  # packages whose key has another name
BROUGHT = {"markupsafe"}  # by jinja2, as a package of a distribution, too


def manifest(package: Path) -> ET.Element:
    return ET.parse(package / "package.xml").getroot()


def dependencies(package: Path) -> set[str]:
    return {str(element.text) for element in manifest(package) if element.tag.endswith("depend")}


def required(package: Path, monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """What pip would install with it."""
    given: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, "setup", given.update)
    monkeypatch.setattr(sys, "argv", ["setup.py", "install"])
    monkeypatch.chdir(package)
    runpy.run_path(str(package / "setup.py"))
    return {re.split("[<>=]", name)[0] for name in given["install_requires"]}


def by_pip() -> set[str]:
    """What the quick start for ROS users installs by pip."""
    page = (ROOT / "docs/ros.md").read_text(encoding="utf-8")
    (words,) = re.findall(r"^    pip install (.*)$", page.replace("\\\n", ""), flags=re.MULTILINE)
    return {re.split("[<>=]", word.strip("'"))[0] for word in words.split()}


def test_least_versions_are_those_that_are_tested() -> None:
    lines = (ROOT / "requirements" / "least.txt").read_text().splitlines()
    tested = {line.replace("==", ">=") for line in lines if "==" in line}
    tested = {
        line for line in tested if not line.startswith(("contourpy", "pandas", "pytz"))
    }  # of matplotlib, or extra
    named = set(re.findall(r'"(\w+>=[\d.]+)"', (ROOT / "analysis" / "setup.py").read_text()))
    assert named == tested | {"pydantic>=2", "click>=8.1.6"}


def test_there_are_packages() -> None:
    assert len(PACKAGES) == 5


def test_every_dependency_has_a_rosdep_key() -> None:
    """Without one, ``rosdep install`` refuses the whole workspace. The list has none that is not used."""
    own = {package.name for package in PACKAGES}
    used = set().union(*map(dependencies, PACKAGES)) - own
    assert used == {key for keys in KEYS.values() for key in keys}


@pytest.mark.parametrize("package", [p for p in PACKAGES if (p / "setup.py").is_file()], ids=lambda p: p.name)
def test_what_has_no_key_comes_by_pip(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = {OF_PYTHON.get(key, key.removeprefix("python3-")) for key in KEYS["rosdep/python.yaml"]}
    assert required(package, monkeypatch) - {p.name for p in PACKAGES} - BROUGHT <= keys | by_pip()
    assert "pydantic" in by_pip()  # the key gives version 1 on Ubuntu 24.04


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: p.name)
def test_released_with_changes_and_licence(package: Path) -> None:
    """What the tools of ROS look for in the folder of a package itself."""
    assert (package / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    changes = (package / "CHANGELOG.rst").read_text().splitlines()
    assert changes[1] == f"Changelog for package {package.name}"
    assert changes[4].split()[0] in ("Forthcoming", manifest(package).findtext("version"))


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: p.name)
def test_every_file_names_its_licence(package: Path) -> None:
    files = {file for file in package.rglob("*.py") if "build" not in file.relative_to(package).parts}
    assert files
    assert [file.name for file in files if not file.read_text(encoding="utf-8").startswith(LICENCE)] == []
