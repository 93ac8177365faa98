"""What the metadata of the wheels say that the sources do not: the ROS 2 that they were built against."""

import re
import runpy
import zipfile
from email import message_from_string
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
REQUIREMENTS = ROOT / "requirements"
PLAIN = "Metadata-Version: 2.4\nName: {0}\nVersion: 0.1.0\nRequires-Dist: msg_analysis\nRequires-Dist: numpy\n\nText\n"


@pytest.fixture(scope="module")
def wheels() -> Any:
    return SimpleNamespace(**runpy.run_path(str(REQUIREMENTS / "wheels.py")))


@pytest.mark.parametrize("distribution", ["jazzy", "kilted"])
def test_messages_require_their_ros(wheels: Any, distribution: str) -> None:
    text = wheels.with_requirements(
        PLAIN.format("msg_agents_interfaces"), "msg_agents_interfaces", "0.1.0", distribution
    )
    metadata = message_from_string(text)
    assert metadata["Version"] == f"0.1.0+{distribution}"
    assert metadata.get_payload() == "Text\n"
    required = metadata.get_all("Requires-Dist") or []
    names = [re.split("[=~]", each)[0] for each in required]
    ros = [line for line in (REQUIREMENTS / distribution / "runtime.in").read_text().split() if line.startswith("ros-")]
    assert names == ["msg_analysis", "numpy", *ros]
    lock = (REQUIREMENTS / distribution / "lock.txt").read_text()
    for each in required[2:]:
        assert f"\n{each.replace('~=', '==')} " in lock


def test_other_wheels_require_the_messages_of_any_ros(wheels: Any) -> None:
    metadata = message_from_string(wheels.with_requirements(PLAIN.format("msg_agents"), "msg_agents", "0.1.0", "jazzy"))
    assert metadata["Version"] == "0.1.0"
    assert metadata.get_all("Requires-Dist") == ["msg_analysis==0.1.0", "numpy", "msg_agents_interfaces==0.1.0"]
    rest = wheels.with_requirements(PLAIN.format("x").partition("\n\n")[0] + "\n", "x", "0.1.0", "jazzy")
    assert message_from_string(rest).get_all("Requires-Dist") == ["msg_analysis==0.1.0", "numpy"]


def test_a_wheel_without_compiled_code_is_refused(wheels: Any, tmp_path: Path) -> None:
    wheel = tmp_path / "msg_analysis-0.1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("msg_analysis/arithmetic/_kernel.pyi", "")
    with pytest.raises(SystemExit, match=r"^error: msg_analysis.*: without the compiled _kernel: install a C compiler"):
        wheels.require_kernel(wheel)
    with zipfile.ZipFile(wheel, "a") as archive:
        archive.writestr("msg_analysis/arithmetic/_kernel.cpython-311-x86_64-linux-gnu.so", "")
    wheels.require_kernel(wheel)


def test_every_python_package_becomes_a_wheel(wheels: Any) -> None:
    """All with a pyproject.toml; the launch files are for an installed ROS 2."""
    sources = {file.parent.name for file in (ROOT / "ros_ws/src").glob("*/pyproject.toml")}
    assert set(wheels.PACKAGES) == sources
