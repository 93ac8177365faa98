"""The structure of both packages: chapters in layers, sizes of files, where ROS is imported.

A chapter is a folder of a package, or a module beside them. Imports that run when a module is imported point down;
those in functions and those for type checkers alone are free.
"""

import ast
import functools
import graphlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {"msg_analysis": ROOT / "analysis/msg_analysis", "msg_agents": ROOT / "msg_agents/msg_agents"}
LAYERS = {  # lowest first; what stands between two slashes may import each other; msg_agents is above msg_analysis
    "msg_analysis": "errors / common / arithmetic / protocol experiment / model / messages / theory / twin / bags / "
    "inference / sweeps / runs / report / __init__ / testing pytest_plugin / paper / cli / __main__",
    "msg_agents": "terminal / discovery / environment / process_layout / channel / stepping / recovery / replay / "
    "watch / run / doctor / nodes / __init__ / testing / cli / __main__",
}
MOST_FILES = 240
MOST_LINES = 500
ROS = re.compile(r"(rclpy|rosidl|ament|launch)|\w+_(msgs|interfaces)$")

Packages = Mapping[str, Path]


def files(packages: Packages) -> dict[str, Path]:
    """Files by the dotted name of their module; a folder's ``__init__.py`` has the name of the folder."""
    found = {}
    for package, folder in packages.items():
        for file in sorted(folder.rglob("*.py")):
            parts = (package, *file.relative_to(folder).with_suffix("").parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def chapter(module: str, packages: Packages) -> str:
    package, _, inner = module.partition(".")
    return f"{package}.{inner.partition('.')[0] or '__init__'}" if package in packages else package


@functools.cache
def imports(text: str) -> list[tuple[str, str, bool]]:
    """Module and name of every import of a file, and whether it is made when the file is imported."""
    found: list[tuple[str, str, bool]] = []
    nodes: list[tuple[ast.AST, bool]] = [(ast.parse(text), True)]
    while nodes:
        node, runs = nodes.pop()
        if isinstance(node, ast.Import):
            found += [(alias.name, "", runs) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "a relative import"
            found += [(str(node.module), alias.name, runs) for alias in node.names]
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            nodes += [*((each, False) for each in node.body), *((each, runs) for each in node.orelse)]
        else:
            runs = runs and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            statements = (each for each in ast.iter_child_nodes(node) if not isinstance(each, ast.expr))
            nodes += [(each, runs) for each in statements]
    return found


def edges(packages: Packages, everywhere: bool = False) -> Iterator[tuple[str, str]]:
    """Modules and what each imports when it is imported itself, or everywhere, in functions and for types too."""
    known = files(packages)
    for module, file in known.items():
        for base, name, runs in imports(file.read_text(encoding="utf-8")):
            if runs or everywhere:
                yield module, f"{base}.{name}" if f"{base}.{name}" in known else base


def upward(packages: Packages, layers: Mapping[str, str]) -> list[str]:
    """Imports from a higher layer, and chapters that no layer has."""
    rows = [(package, line) for package in layers for line in layers[package].split("/")]
    height = {f"{package}.{name}": i for i, (package, line) in enumerate(rows) for name in line.split()}
    chapters = {chapter(module, packages) for module in files(packages)}
    found = {f"{mine}: in no layer" for mine in chapters - height.keys()}
    for module, other in edges(packages):
        if height.get(chapter(other, packages), -1) > height.get(chapter(module, packages), -1):
            found.add(f"{module} imports {other}")
    return sorted(found)


def cycle(packages: Packages) -> list[str]:
    graph: dict[str, set[str]] = {}
    for module, other in edges(packages):
        graph.setdefault(module, set()).add(other)
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return sorted(set(error.args[1]))
    return []


def misplaced(packages: Packages) -> list[str]:
    """What imports ROS outside of msg_agents.nodes, or the paper outside of the commands, in functions too."""
    known, found = files(packages), set()
    for module, other in edges(packages, everywhere=True):
        mine = chapter(module, packages)
        ros = other not in known and ROS.match(other.split(".")[0]) and mine != "msg_agents.nodes"
        paper = chapter(other, packages) == "msg_analysis.paper" and mine.split(".")[-1] not in ("paper", "cli")
        if ros or paper:
            found.add(f"{module} imports {other}")
    return sorted(found)


def without_description(packages: Packages) -> list[str]:
    """Folders whose ``__init__.py`` is missing, has no docstring, or does something; those of packages may import."""
    found = []
    for package, folder in packages.items():
        for inner in {folder, *(file.parent for file in folder.rglob("*.py"))}:
            file = inner / "__init__.py"
            tree = ast.parse(file.read_text(encoding="utf-8") if file.is_file() else "")
            if not ast.get_docstring(tree) or (inner != folder and len(tree.body) > 1):
                found.append(".".join((package, *inner.relative_to(folder).parts)))
    return sorted(found)


def too_long(packages: Packages, most: int = MOST_LINES) -> list[str]:
    return [name for name, file in files(packages).items() if len(file.read_text("utf-8").splitlines()) > most]


def test_the_packages() -> None:
    assert upward(PACKAGES, LAYERS) == []
    assert cycle(PACKAGES) == []
    assert misplaced(PACKAGES) == []
    assert without_description(PACKAGES) == []
    assert too_long(PACKAGES) == []
    assert 100 < len(files(PACKAGES)) <= MOST_FILES
    listed = {f"{package}.{name}" for package in LAYERS for name in LAYERS[package].replace("/", " ").split()}
    assert listed == {chapter(module, PACKAGES) for module in files(PACKAGES)}


MADE_LAYERS = {
    "msg_analysis": "errors / model theory / paper / cli / __init__",
    "msg_agents": "stepping / nodes / __init__",
}
MADE = {
    "msg_analysis/__init__.py": '"""The lower package."""\nfrom msg_analysis.model import run',
    "msg_analysis/errors.py": "",
    "msg_analysis/model/__init__.py": '"""Models."""',
    "msg_analysis/model/run.py": "import msg_analysis.errors\ndef later():\n    from msg_analysis.cli import main",
    "msg_analysis/theory/__init__.py": '"""Theory."""',
    "msg_analysis/theory/moments.py": "import typing\nif typing.TYPE_CHECKING:\n    import msg_analysis.cli",
    "msg_analysis/paper/__init__.py": '"""The paper."""',
    "msg_analysis/cli/__init__.py": '"""Commands."""',
    "msg_analysis/cli/main.py": "def figures():\n    import msg_analysis.paper",
    "msg_agents/__init__.py": '"""The upper package."""',
    "msg_agents/stepping/__init__.py": '"""No ROS."""',
    "msg_agents/stepping/gate.py": "from msg_analysis import errors",
    "msg_agents/nodes/__init__.py": '"""Nodes."""',
    "msg_agents/nodes/agent.py": "import rclpy\nfrom msg_agents.stepping.gate import Gate",
}


@pytest.fixture
def made(tmp_path: Path) -> Packages:
    for name, text in MADE.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{text}\n")
    return {package: tmp_path / package for package in MADE_LAYERS}


def add(packages: Packages, name: str, line: str) -> None:
    with (packages["msg_analysis"] / name).open("a") as file:
        file.write(f"{line}\n")


def test_a_package_in_order_passes(made: Packages) -> None:
    assert [upward(made, MADE_LAYERS), cycle(made), misplaced(made), without_description(made)] == [[]] * 4


@pytest.mark.parametrize(
    ("file", "line", "found"),
    [
        ("errors.py", "from msg_analysis.model import run", "msg_analysis.errors imports msg_analysis.model.run"),
        ("model/run.py", "class A:\n    import msg_agents", "msg_analysis.model.run imports msg_agents"),
        ("../msg_agents/clock.py", "", "msg_agents.clock: in no layer"),
    ],
)
def test_an_import_that_points_up_is_found(made: Packages, file: str, line: str, found: str) -> None:
    add(made, file, line)
    assert upward(made, MADE_LAYERS) == [found]


def test_a_cycle_in_one_layer_is_found(made: Packages) -> None:
    add(made, "model/run.py", "if True:\n    from msg_analysis.theory import moments")
    add(made, "theory/moments.py", "def later():\n    import msg_analysis.model.run")
    assert cycle(made) == []
    add(made, "theory/moments.py", "import msg_analysis.model.run")
    assert upward(made, MADE_LAYERS) == []
    assert cycle(made) == ["msg_analysis.model.run", "msg_analysis.theory.moments"]


@pytest.mark.parametrize("module", ["rclpy.qos", "std_msgs.msg", "msg_agents_interfaces", "msg_analysis.paper"])
def test_ros_or_paper_in_the_wrong_place_is_found(made: Packages, module: str) -> None:
    add(made, "../msg_agents/stepping/gate.py", f"def f():\n    import {module}")
    assert misplaced(made) == [f"msg_agents.stepping.gate imports {module}"]


def test_a_folder_without_a_description_is_found(made: Packages) -> None:
    (made["msg_analysis"] / "model/__init__.py").write_text("")
    (made["msg_analysis"] / "cli/__init__.py").unlink()
    add(made, "../msg_agents/nodes/__init__.py", "import os")
    assert without_description(made) == ["msg_agents.nodes", "msg_analysis.cli", "msg_analysis.model"]


def test_a_long_file_is_found(made: Packages) -> None:
    assert too_long(made, most=2) == ["msg_analysis.model.run", "msg_analysis.theory.moments"]


def test_a_relative_import_is_refused(made: Packages) -> None:
    add(made, "model/run.py", "from .step import law")
    with pytest.raises(AssertionError, match="relative import"):
        cycle(made)
