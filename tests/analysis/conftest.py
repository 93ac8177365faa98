"""Packages that offer protocols, and rosbags as the independent judge of bytes and bags."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from msg_analysis.experiment import protocols

ROOT = Path(__file__).parents[2]
INTERFACES = ROOT / "ros_ws" / "src" / "msg_agents_interfaces" / "msg"


@pytest.fixture(scope="session")
def typestore() -> Any:
    """Jazzy's types and ours, from the .msg files of the ROS package."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for file in sorted(INTERFACES.glob("*.msg")):
        store.register(get_types_from_msg(file.read_text(), f"msg_agents_interfaces/msg/{file.stem}"))
    return store


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
        monkeypatch.setattr(protocols, "offered", lambda: tuple(points))

    return have
