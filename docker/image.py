"""What an image is built from where no registry of images is within reach: a fresh Debian, and options of the build."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
DEBIAN, PACKAGES = "bookworm", "ca-certificates,python3"
BUILD_PACKAGES = "g++ python3-venv python3-dev"
LEFT_OUT = [
    *(f"usr/share/{name}" for name in ("doc", "info", "locale", "man")),
    *("var/lib/apt/lists", "var/cache/apt"),
]
"""As in Debian's slim images: documentation, translations, and what apt keeps."""
SECRETS = {"pip": Path("/etc/pip.conf"), "certificates": Path("/etc/ssl/certs/ca-certificates.crt")}


def base_system(folder: Path) -> Path:
    """The root of a Debian with Python, made in a folder by debootstrap unless it is there already."""
    root, unfinished = folder / "base", folder / "base.unfinished"
    if not root.exists():
        if os.geteuid() != 0 or shutil.which("debootstrap") is None:
            sys.exit(
                "error: a fresh base needs root and debootstrap (apt-get install debootstrap); or give --base IMAGE"
            )
        shutil.rmtree(unfinished, ignore_errors=True)
        print(f"debootstrap {DEBIAN} into {root}", file=sys.stderr)
        command = ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", DEBIAN, str(unfinished)]
        subprocess.run(command, check=True, stdout=sys.stderr)
        for name in LEFT_OUT:
            shutil.rmtree(unfinished / name, ignore_errors=True)
            (unfinished / name).mkdir()
        unfinished.rename(root)
    return root


def build_options(base: str) -> list[str | Path]:
    """For the Dockerfile on a base; with where this machine gets Python packages from, and its certificates."""
    arguments = {"BASE": base, "BUILD_PACKAGES": BUILD_PACKAGES}
    secrets = {name: path for name, path in SECRETS.items() if path.exists()}
    return [
        *(word for name, value in arguments.items() for word in ("--build-arg", f"{name}={value}")),
        *(word for name, path in secrets.items() for word in ("--secret", f"id={name},src={path}")),
        *("--file", HERE / "Dockerfile"),
    ]
