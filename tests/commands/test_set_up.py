"""What ``make setup`` runs: uv gets the places in which pip looks for packages."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

import pytest

FILE = Path(__file__).parents[2] / "requirements" / "install.py"


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Any:
    for name in list(os.environ):
        if name.startswith("PIP_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)  # nor the files of this machine
    spec = importlib.util.spec_from_file_location("install", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def pinned(file: str) -> dict[str, list[str]]:
    """Hashes by package, version, and the Pythons that it is for."""
    found: dict[str, list[str]] = {}
    name = ""
    for line in (FILE.parent / file).read_text().splitlines():
        words = line.rstrip(" \\").strip()
        if words.startswith("--hash="):
            found[name].append(words)
        elif "==" in words and not words.startswith("#"):
            name = words
            found[name] = []
    return found


def test_what_is_installed_first_is_what_is_installed_in_the_end() -> None:
    first, everything = pinned("interfaces.txt"), pinned("lock.txt")
    assert "scikit-build-core" in " ".join(first)
    assert all(first.values())
    assert first.items() <= everything.items()
