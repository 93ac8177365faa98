"""The rules of layers, for packages in folders: each gives what breaks it.

A layer is a folder, without its sub-folders, or a module beside them.
"""

import ast
import functools
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import networkx as nx

MOST_FILES = 10  # in a folder
ROS = re.compile(r"(rclpy|rosidl|ament|launch)|\w+_(msgs|interfaces)$")

Places = Mapping[str, Path]
Layers = Mapping[str, Sequence[str]]


def modules(places: Places) -> dict[str, Path]:
    """Files by dotted name; a package has the name of its folder."""
    found = {}
    for package, folder in places.items():
        for file in sorted(folder.rglob("*.py")):
            parts = (package, *file.relative_to(folder).with_suffix("").parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imported(file: Path, known: Mapping[str, Path]) -> Iterator[str]:
    """Every module that a file imports, wherever: at its top, in functions, or for type checkers only."""
    for node in _import_statements(file.read_text(encoding="utf-8")):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        else:
            assert node.level == 0, f"{file}: a relative import"
            assert node.module
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in known else node.module


@functools.cache
def _import_statements(source: str) -> list[ast.Import | ast.ImportFrom]:
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import | ast.ImportFrom)]


def graph(places: Places) -> nx.DiGraph:
    """Which module imports which; names of other packages are in it, too."""
    known = modules(places)
    found = nx.DiGraph()
    found.add_nodes_from(known)
    for name, file in known.items():
        found.add_edges_from((name, other) for other in imported(file, known))
    return found


def layer(file: Path, places: Places) -> str:
    """The layer of a file: its folder, or the file itself where that is the folder of the package."""
    for package, folder in places.items():
        if file.is_relative_to(folder):
            place = file.relative_to(folder)
            return f"{package}/{place.with_suffix('') if place.parent == Path() else place.parent.as_posix()}"
    raise AssertionError(file)


def heights(layers: Layers) -> dict[str, int]:
    return {name: i for i, name in enumerate(f"{package}/{each}" for package in layers for each in layers[package])}


def unknown_layers(places: Places, layers: Layers) -> list[str]:
    """Layers that are not listed, or listed and not there. A folder that has only folders is none."""
    there = {
        layer(file, places)
        for name, file in modules(places).items()
        if file.name != "__init__.py" or name in places  # of a folder it is a docstring
    }
    return sorted(there ^ set(heights(layers)))


def upward_imports(places: Places, layers: Layers) -> list[str]:
    known, height = modules(places), heights(layers)
    found = []
    for name, other in graph(places).edges:
        if other in known:
            mine, its = layer(known[name], places), layer(known[other], places)
            if height.get(its, -1) > height.get(mine, -1):
                found.append(f"{name} imports {other}")
    return sorted(found)


def cycles(places: Places) -> list[list[str]]:
    found = graph(places)
    return sorted(sorted(group) for group in nx.strongly_connected_components(found) if len(group) > 1)


def not_only_a_docstring(places: Places) -> list[str]:
    """Folders whose ``__init__.py`` is missing, says nothing, or does something. Those of the packages may import."""
    found = []
    for package, folder in places.items():
        for inner in sorted({folder, *(file.parent for file in folder.rglob("*.py"))}):
            file = inner / "__init__.py"
            tree = ast.parse(file.read_text(encoding="utf-8") if file.is_file() else "")
            if not ast.get_docstring(tree) or (inner != folder and len(tree.body) > 1):
                found.append(f"{package}/{inner.relative_to(folder).as_posix()}")
    return found


def crowded(places: Places) -> list[str]:
    """Folders with so many files that nobody reads their names: they need sub-folders."""
    files = [name.split(".") for name, file in modules(places).items() if not file.stem.startswith("__")]
    counts = Counter("/".join(parts[:-1]) for parts in files)
    return sorted(name for name, count in counts.items() if count > MOST_FILES)


def ros_outside(places: Places, allowed: str) -> list[str]:
    """What imports ROS, for type checkers included, without being in the folder for that."""
    known = modules(places)
    return sorted(
        f"{name} imports {other}"
        for name, other in graph(places).edges
        if other not in known
        and ROS.match(other.split(".")[0])
        and not f"{layer(known[name], places)}/".startswith(f"{allowed}/")
    )


def imports_of(places: Places, only_for: Mapping[str, str]) -> list[str]:
    """Who imports a folder that only one other may import."""
    known = modules(places)
    found = []
    for name, other in graph(places).edges:
        if other in known:
            mine, its = layer(known[name], places), layer(known[other], places)
            if its in only_for and mine not in (its, only_for[its]):
                found.append(f"{name} imports {other}")
    return sorted(found)


def described(page: str, package: str) -> list[str]:
    """First cells of the table below the heading of a package."""
    section = page.partition(f"#### {package}\n")[2].partition("\n#")[0]
    return re.findall(r"^\| (\**`[^`]+`\**) \|", section, flags=re.MULTILINE)


def undescribed(places: Places, page: str) -> list[str]:
    """Files without a row of their own, and rows without a file."""
    found = []
    for package, folder in places.items():
        rows = [row.strip("*`") for row in described(page, package)]
        there = {
            file.relative_to(folder).as_posix()
            for file in folder.rglob("*.py")
            if file.name != "__init__.py" or file.parent == folder
        }
        found += [f"{package}/{name}" for name in there ^ {row for row in rows if row.endswith(".py")}]
        found += [f"{package}/{row}: twice" for row in set(rows) if rows.count(row) > 1]
    return sorted(found)


def described_layers(page: str, package: str) -> list[str]:
    """The layers in the order of the page: rows in bold."""
    rows = [row.strip("*`") for row in described(page, package) if row.startswith("**")]
    return [row.rstrip("/").removesuffix(".py") for row in rows]
