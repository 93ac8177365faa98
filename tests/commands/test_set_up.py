"""What ``make setup`` runs, with which packages: uv gets the places in which pip looks for them."""

import os
import re
import runpy
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

REQUIREMENTS = Path(__file__).parents[2] / "requirements"
FILE = REQUIREMENTS / "install.py"
DISTRIBUTIONS = sorted(file.parent.name for file in REQUIREMENTS.glob("*/runtime.in"))


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Any:
    for name in list(os.environ):
        if name.startswith("PIP_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)  # nor the files of this machine
    return SimpleNamespace(**runpy.run_path(str(FILE)))


def test_by_default_uv_looks_where_it_wants(install: Any) -> None:
    assert install.variables_of_uv() == {}


def test_settings_of_pip(install: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From its file and the environment; without folders that are not there, which pip ignores and uv does not."""
    here, gone = tmp_path / "here", tmp_path / "gone"
    here.mkdir()
    config = tmp_path / "pip.conf"
    config.write_text(
        f"[global]\nindex-url = https://mirror.example/simple\n"
        f"extra-index-url = {gone.as_uri()}\n  {here.as_uri()} https://second.example/simple\n"
        f"find-links = {gone} {here}\ntimeout = 60\n[install]\ncert = /etc/some.pem\n[download]\ntimeout = 9\n"
    )
    Path(tmp_path / "some.pem").touch()
    monkeypatch.setenv("PIP_CONFIG_FILE", str(config))
    monkeypatch.setenv("PIP_TRUSTED_HOST", "mirror.example second.example")
    monkeypatch.setenv("PIP_CERT", str(tmp_path / "some.pem"))
    assert install.variables_of_uv() == {
        "UV_DEFAULT_INDEX": "https://mirror.example/simple",
        "UV_INDEX": f"{here.as_uri()} https://second.example/simple",
        "UV_FIND_LINKS": str(here),
        "UV_INSECURE_HOST": "mirror.example second.example",
        "UV_HTTP_TIMEOUT": "60",
        "SSL_CERT_FILE": str(tmp_path / "some.pem"),
    }


def test_a_pip_that_installs_elsewhere(install: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As with a `target` in its file: one error instead of a traceback."""
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=0))
    monkeypatch.setitem(install.main.__globals__, "PROGRAM", tmp_path / "uv")
    with pytest.raises(SystemExit, match="error: pip has installed uv elsewhere than in"):
        install.main("jazzy")


def pinned(file: str) -> dict[str, list[str]]:
    """Hashes by package, version, and the Pythons that it is for."""
    found: dict[str, list[str]] = {}
    name = ""
    for line in (REQUIREMENTS / file).read_text().splitlines():
        words = line.rstrip(" \\").strip()
        if words.startswith("--hash=sha256:"):
            found[name].append(words)
        elif words and not words.startswith("#"):
            assert re.match(r"[\w.-]+==\S+( ; .*)?$", words), f"{file}: {words}: neither a pin nor a hash"
            name = words
            found[name] = []
    return found


def test_there_are_distributions() -> None:
    assert {"jazzy", "kilted"} <= set(DISTRIBUTIONS)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_what_is_installed_first_is_what_is_installed_in_the_end(distribution: str) -> None:
    first, everything = pinned(f"{distribution}/interfaces.txt"), pinned(f"{distribution}/lock.txt")
    assert "scikit-build-core" in " ".join(first)
    assert all(everything.values())
    assert first.items() <= everything.items()


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_a_lock_is_of_one_distribution(distribution: str) -> None:
    names = " ".join(pinned(f"{distribution}/lock.txt"))
    assert f"ros-{distribution}-rclpy==" in names
    assert [other for other in DISTRIBUTIONS if f"ros-{other}-" in names] == [distribution]


def make(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """What make would do, without doing it."""
    outside = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    command = ["make", "--no-print-directory", "--dry-run", "--always-make", "--directory", str(FILE.parents[1])]
    return subprocess.run([*command, *words], env=outside | environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("distribution", "folder"), [(name, ".venv" if name == "jazzy" else f".venv-{name}") for name in DISTRIBUTIONS]
)
def test_each_distribution_has_its_environment(distribution: str, folder: str) -> None:
    shown = make("setup", f"ROS_DISTRO={distribution}").stdout
    assert f"{folder}/bin/python requirements/install.py {distribution}\n" in shown
    assert set(re.findall(r"\.venv[\w-]*", shown)) == {folder}


def test_a_sourced_ros_changes_nothing() -> None:
    assert make("setup", ROS_DISTRO="kilted").stdout == make("setup").stdout == make("setup", "ROS_DISTRO=jazzy").stdout


def test_an_unknown_distribution() -> None:
    result = make("demo", "ROS_DISTRO=foxy")
    assert (result.returncode, result.stdout) == (2, "")
    assert f"ROS_DISTRO=foxy: no requirements for it: expected one of: {' '.join(DISTRIBUTIONS)}." in result.stderr


def test_places_of_the_users_pip_are_not_used() -> None:
    """With PIP_USER pip refuses to install into an environment, with the others it installs elsewhere."""
    given = {"PIP_USER": "1", "PIP_TARGET": "/nowhere", "PIP_PREFIX": "/nowhere", "PIP_ROOT": "/nowhere"}
    show = [
        "make",
        "--silent",
        "--directory",
        str(Path(__file__).parents[2]),
        "--eval=show-environment: ; @env",
        "show-environment",
    ]
    shown = subprocess.run(show, env=os.environ | given, capture_output=True, text=True, check=True)
    assert [line for line in shown.stdout.splitlines() if line.split("=")[0] in given] == ["PIP_USER=0"]
