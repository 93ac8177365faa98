"""Packages that offer protocols."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from msg_analysis.model import protocols


@pytest.fixture
def offer(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Have packages that offer protocols, instead of those that are installed."""

    def have(*offers: tuple[str, Any], package: str = "pack", version: str = "1.2") -> None:
        dist = SimpleNamespace(name=package, version=version)
        points = [
            SimpleNamespace(
                name=name,
                value=f"pack.module:{name}",
                dist=dist,
                load=kind if not isinstance(kind, type) else (lambda kind=kind: kind),
            )
            for name, kind in offers
        ]
        monkeypatch.setattr(protocols, "entry_points", lambda group: points)

    return have
