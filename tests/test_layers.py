"""The layers of both packages: imports point down, and docs/contributing.md lists the same folders and files.

A layer is a folder, without its sub-folders, or a module beside them. What stands here is the only list of the order.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from layer_rules import (
    MOST_FILES,
    Places,
    crowded,
    cycles,
    described_layers,
    graph,
    imports_of,
    modules,
    not_only_a_docstring,
    ros_outside,
    undescribed,
    unknown_layers,
    upward_imports,
)

ROOT = Path(__file__).parents[1]
PLACES = {"msg_analysis": ROOT / "analysis/msg_analysis", "msg_agents": ROOT / "msg_agents/msg_agents"}
LAYERS = {  # lowest first; msg_agents is above msg_analysis
    "msg_analysis": [
        "errors",
        "types",
        "common",
        "common/text",
        "examples",
        "model/network",
        "model/arithmetic",
        "protocol",
        "model/spec",
        "model/experiment",
        "model/step",
        "model/run",
        "wire",
        "theory/system",
        "theory/solvers",
        "theory/tails",
        "theory",
        "theory/leaders",
        "twin",
        "bags/format",
        "bags",
        "inference/statistics",
        "inference/evidence",
        "inference/observed",
        "inference/hypothesis_tests",
        "inference/departures",
        "inference/errors",
        "inference/sequential",
        "inference/planning",
        "inference/realtime",
        "inference/blame",
        "inference/verdict",
        "inference/online",
        "sweep/jobs",
        "sweep",
        "report/documents",
        "runs",
        "report/export",
        "report/figures",
        "report/terminal",
        "report/html/plots",
        "report/html",
        "results",
        "api",
        "__init__",
        "paper",
        "cli",
        "__main__",
    ],
    "msg_agents": [
        "stepping",
        "terminal",
        "discovery",
        "processes",
        "channel",
        "recovery",
        "replay",
        "watching",
        "running",
        "doctor",
        "__init__",
        "nodes/ros",
        "nodes",
        "nodes/agents",
        "nodes/watching",
        "nodes/replay",
        "cli",
        "cli/servers",
        "__main__",
    ],
}
WITH_ROS = "msg_agents/nodes"
ONLY_FOR = {"msg_analysis/paper": "msg_analysis/cli"}  # nothing else imports it


def test_there_is_something_to_look_at() -> None:
    assert len(modules(PLACES)) > 200
    assert graph(PLACES).number_of_edges() > 800


def test_every_folder_is_a_layer() -> None:
    assert unknown_layers(PLACES, LAYERS) == []


def test_imports_point_down() -> None:
    assert upward_imports(PLACES, LAYERS) == []


def test_no_cycles() -> None:
    assert cycles(PLACES) == []


def test_every_folder_says_what_belongs_there() -> None:
    assert not_only_a_docstring(PLACES) == []


def test_no_folder_is_crowded() -> None:
    assert crowded(PLACES) == []


def test_ros_is_in_one_folder() -> None:
    assert ros_outside(PLACES, WITH_ROS) == []


def test_only_the_commands_import_the_paper() -> None:
    assert imports_of(PLACES, ONLY_FOR) == []


def test_contributing_lists_every_file() -> None:
    assert undescribed(PLACES, (ROOT / "docs/contributing.md").read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("package", PLACES)
def test_contributing_lists_the_layers_in_this_order(package: str) -> None:
    page = (ROOT / "docs/contributing.md").read_text(encoding="utf-8")
    assert described_layers(page, package) == LAYERS[package]


# A small house, in order: each test below breaks one rule in it.
MADE_LAYERS = {
    "lower": ["errors", "model/step", "model", "paper", "cli", "__init__"],
    "upper": ["pure", "nodes", "__init__"],
}
MADE = {
    "lower/__init__.py": '"""The lower package."""\nfrom lower.model import run',
    "lower/errors.py": "",
    "lower/model/__init__.py": '"""Models."""',
    "lower/model/run.py": "from lower.model.step import law\nfrom lower.errors import Bad",
    "lower/model/step/__init__.py": '"""Steps."""',
    "lower/model/step/law.py": "import lower.errors",
    "lower/model/step/noise.py": "",
    "lower/paper/__init__.py": '"""The paper."""',
    "lower/paper/figures.py": "from lower.model.run import start",
    "lower/cli/__init__.py": '"""Commands."""',
    "lower/cli/main.py": "def figures():\n    from lower.paper import figures",
    "upper/__init__.py": '"""The upper package."""',
    "upper/pure/__init__.py": '"""No ROS."""',
    "upper/pure/gate.py": "from lower import errors",
    "upper/nodes/__init__.py": '"""Nodes."""',
    "upper/nodes/agent.py": "import rclpy\nfrom upper.pure.gate import Gate\nfrom std_msgs.msg import String",
}
MADE_PAGE = """
#### lower

| path | contents |
|---|---|
| **`errors.py`** | errors |
| **`model/step/`** | steps |
| `model/step/law.py` | law |
| `model/step/noise.py` | noise |
| **`model/`** | models |
| `model/run.py` | run |
| **`paper/`** | paper |
| `paper/figures.py` | figures |
| **`cli/`** | commands |
| `cli/main.py` | all of them |
| **`__init__.py`** | names |

#### upper

| path | contents |
|---|---|
| **`pure/`** | pure |
| `pure/gate.py` | gate |
| **`nodes/`** | nodes |
| `nodes/agent.py` | agent |
| **`__init__.py`** | names |

## Next
"""


@pytest.fixture
def made(tmp_path: Path) -> Places:
    for name, text in MADE.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return {package: tmp_path / package for package in MADE_LAYERS}


def add(places: Places, name: str, line: str) -> None:
    file = next(iter(places.values())).parent / name
    file.write_text(f"{file.read_text() if file.exists() else ''}\n{line}\n")


def test_a_house_in_order_passes(made: Places) -> None:
    assert unknown_layers(made, MADE_LAYERS) == []
    assert upward_imports(made, MADE_LAYERS) == []
    assert cycles(made) == []
    assert not_only_a_docstring(made) == []
    assert ros_outside(made, "upper/nodes") == []
    assert crowded(made) == []
    assert imports_of(made, {"lower/paper": "lower/cli"}) == []
    assert undescribed(made, MADE_PAGE) == []
    assert {package: described_layers(MADE_PAGE, package) for package in made} == MADE_LAYERS


@pytest.mark.parametrize(
    ("file", "line", "found"),
    [
        ("lower/errors.py", "import lower.model.run", "lower.errors imports lower.model.run"),
        ("lower/errors.py", "from lower.model import run", "lower.errors imports lower.model.run"),
        ("lower/model/step/law.py", "from lower.model.run import a", "lower.model.step.law imports lower.model.run"),
        ("lower/model/run.py", "from lower import start", "lower.model.run imports lower"),
        ("lower/cli/main.py", "from upper.pure.gate import Gate", "lower.cli.main imports upper.pure.gate"),
        ("upper/pure/gate.py", "def f():\n    import upper.nodes.agent", "upper.pure.gate imports upper.nodes.agent"),
        (
            "lower/model/run.py",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from lower.paper.figures import Figure",
            "lower.model.run imports lower.paper.figures",
        ),
    ],
)
def test_an_import_that_points_up_is_found(made: Places, file: str, line: str, found: str) -> None:
    add(made, file, line)
    assert upward_imports(made, MADE_LAYERS) == [found]


@pytest.mark.parametrize(
    "line",
    [
        "from lower.model.step import noise",
        "def f():\n    import lower.model.step.noise",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from lower.model.step.noise import Noise",
    ],
)
def test_a_cycle_in_one_folder_is_found(made: Places, line: str) -> None:
    add(made, "lower/model/step/noise.py", "from lower.model.step.law import step")
    assert cycles(made) == []
    add(made, "lower/model/step/law.py", line)
    assert upward_imports(made, MADE_LAYERS) == []
    assert cycles(made) == [["lower.model.step.law", "lower.model.step.noise"]]


def test_a_longer_cycle_is_found(made: Places) -> None:
    add(made, "lower/errors.py", "from lower.model.run import start")
    assert cycles(made) == [["lower.errors", "lower.model.run", "lower.model.step.law"]]


def test_a_folder_that_is_not_listed_is_found(made: Places) -> None:
    (made["upper"] / "extra").mkdir()
    add(made, "upper/extra/__init__.py", '"""More."""')
    assert unknown_layers(made, MADE_LAYERS) == []  # as long as nothing is in it
    add(made, "upper/extra/more.py", "")
    assert unknown_layers(made, MADE_LAYERS) == ["upper/extra"]


def test_a_module_beside_the_folders_that_is_not_listed_is_found(made: Places) -> None:
    add(made, "upper/loose.py", "")
    assert unknown_layers(made, MADE_LAYERS) == ["upper/loose"]


def test_a_layer_that_is_not_there_is_found(made: Places) -> None:
    (made["lower"] / "errors.py").unlink()
    assert unknown_layers(made, MADE_LAYERS) == ["lower/errors"]


def test_a_folder_without_a_docstring_is_found(made: Places) -> None:
    (made["lower"] / "model/step/__init__.py").write_text("")
    (made["upper"] / "pure/__init__.py").unlink()
    assert not_only_a_docstring(made) == ["lower/model/step", "upper/pure"]


def test_a_folder_that_does_something_is_found(made: Places) -> None:
    add(made, "lower/model/__init__.py", "from lower.model.run import start")
    assert not_only_a_docstring(made) == ["lower/model"]


def test_a_crowded_folder_is_found(made: Places) -> None:
    for i in range(MOST_FILES - 1):
        add(made, f"upper/pure/more_{i}.py", "")
    assert crowded(made) == []
    add(made, "upper/pure/one_more.py", "")
    assert crowded(made) == ["upper/pure"]


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("import rclpy", "rclpy"),
        ("from rclpy.node import Node", "rclpy.node"),
        ("from std_msgs.msg import String", "std_msgs.msg"),
        ("from msg_agents_interfaces.msg import AgentState", "msg_agents_interfaces.msg"),
        ("def f():\n    import rosidl_runtime_py", "rosidl_runtime_py"),
    ],
)
def test_ros_in_another_folder_is_found(made: Places, line: str, found: str) -> None:
    add(made, "upper/pure/gate.py", line)
    assert ros_outside(made, "upper/nodes") == [f"upper.pure.gate imports {found}"]


def test_an_import_of_the_paper_is_found(made: Places) -> None:
    add(made, "upper/nodes/agent.py", "from lower.paper import figures")
    assert upward_imports(made, MADE_LAYERS) == []
    assert imports_of(made, {"lower/paper": "lower/cli"}) == ["upper.nodes.agent imports lower.paper.figures"]


def test_a_file_that_no_page_lists_is_found(made: Places) -> None:
    add(made, "upper/pure/clock.py", "")
    assert undescribed(made, MADE_PAGE) == ["upper/pure/clock.py"]


def test_a_row_without_a_file_is_found(made: Places) -> None:
    (made["upper"] / "pure/gate.py").unlink()
    assert undescribed(made, MADE_PAGE) == ["upper/pure/gate.py"]
    assert undescribed(made, MADE_PAGE.replace("pure/gate.py", "nodes/agent.py")) == ["upper/nodes/agent.py: twice"]


def test_a_relative_import_is_refused(made: Places) -> None:
    add(made, "lower/model/run.py", "from .step import law")
    with pytest.raises(AssertionError, match="relative import"):
        graph(made)
