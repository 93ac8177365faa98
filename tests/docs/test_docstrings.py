"""Docstrings follow the rule of docs/contributing.md, as tests/support/docstring_rule.py has it."""

from __future__ import annotations

import re
from pathlib import Path

import griffe
import pytest
from docstring_rule import FOLDERS, ROOT, Api, findings, found_at, members, written


def paths() -> list[str]:
    """Of all modules, from the names of their files: packages are loaded by the tests only."""
    files = [
        file.relative_to(ROOT / folder)
        for name, folder in FOLDERS.items()
        for file in (ROOT / folder / name).rglob("*.py")
        if file.name != "__main__.py"
    ]
    return sorted(".".join(file.with_suffix("").parts).removesuffix(".__init__") for file in files)


@pytest.mark.parametrize("path", paths())
def test_docstrings_follow_the_rule(path: str) -> None:
    found = list(findings(written().modules[path], written().api))
    assert not found, "\n".join(["", *found])


def test_there_is_something_to_look_at() -> None:
    assert sorted(written().modules) == paths()
    assert len(paths()) > 120
    assert sum(1 for module in written().modules.values() for _, public in members(module) if public) > 600
    assert len(written().api.full) > 30


@pytest.mark.parametrize(
    "path",
    [
        "msg_analysis.experiment.experiment.Experiment",  # exported
        "msg_analysis.errors.BagError",  # exported, and in a module that docs/api.md names
    ],
)
def test_the_api_is_found(path: str) -> None:
    assert path in written().api.full


def test_everything_in_the_api_has_a_docstring() -> None:
    assert [path for path in sorted(written().api.full) if not found_at(path, written().collection).has_docstring] == []


def test_classes_in_signatures_are_found() -> None:
    assert {path.rpartition(".")[2] for path in written().api.mentioned} >= {"RunRecord", "Run", "Comparison"}


HEAD = '"""Written for a test."""\n\n'


def loaded(tmp_path: Path, path: str, code: str) -> griffe.Module:
    """A module of a package made for this test."""
    file = tmp_path.joinpath(*path.split(".")).with_suffix(".py")
    file.parent.mkdir(parents=True)
    for parent in file.relative_to(tmp_path).parents[:-1]:
        (tmp_path / parent / "__init__.py").write_text('"""After Somebody 1984."""')
    file.write_text(code)
    module = griffe.load(path, search_paths=[tmp_path], docstring_parser="numpy", allow_inspection=False)
    assert isinstance(module, griffe.Module)
    return module


def made(signature: str, *sections: str, body: str = "", first: str = "Do.") -> str:
    """Source of a function, or class, with a docstring of the given sections: "Parameters x: what it is"."""
    text = first
    for section in sections:
        title, entry, words = re.fullmatch(r"(\w+) (\w+): (.*)", section).groups()  # type: ignore[union-attr]
        text += f"\n\n    {title}\n    {'-' * len(title)}\n    {entry}\n        {words}"
    return f'{signature}\n    """{text}\n    """\n    {body}\n'


DATACLASS = "from dataclasses import dataclass\n\n@dataclass\nclass C:"
FULL = [  # what is found where everything has to be documented
    ("def f(x): ...", ["f: no docstring"]),
    (made("def f(x):"), ["f: x: not documented"]),
    (made("def f(x):", "Parameters y: it"), ["f: x: not documented", "f: y: documented, but no argument"]),
    (made("def f(x):", "Parameters x: it"), []),
    (made("def f(x: FloatArray):", "Parameters x: it"), ["f: x: no shape in 'it'"]),
    (made("def f(x: FloatArray):", "Parameters x: (m, n) it"), []),
    (made("def f(dt: float):", "Parameters dt: it"), ["f: dt: no unit in 'it'"]),
    (made("def f(dt: float):", "Parameters dt: it [s]"), []),
    (made("def f() -> FloatArray:"), ["f: no shape of what it returns"]),
    (made("def f() -> FloatArray:", "Returns FloatArray: (m,) errors"), []),
    (made("def f():", body="raise InputError('x')"), ["f: raises InputError: not documented"]),
    (made("def f():", "Raises InputError: never", body="raise InputError('x')"), []),
    (made(DATACLASS, body="x: int"), ["C: x: not documented"]),
    (made(DATACLASS, "Attributes x: it", body="x: int"), []),
    (made("class C:", body="def f(self, x):\n        'Do.'"), ["C.f: x: not documented"]),
    (
        made("class C:", body="@property\n    def p(self) -> FloatArray:\n        'It.'"),
        ["C.p: no shape of what it returns"],
    ),
    (made("class C:", body="@property\n    def p(self) -> FloatArray:\n        '(m,) it.'"), []),
    (made("class C:", body="def _f(self, x): ..."), []),
    ("def _f(x): ...", []),
]


@pytest.mark.parametrize(("code", "found"), FULL)
def test_it_finds_what_the_api_lacks(code: str, found: list[str], tmp_path: Path) -> None:
    path = "msg_analysis.report.made"
    assert list(findings(loaded(tmp_path, path, HEAD + code), Api(full=[f"{path}.f", f"{path}.C"]))) == found


SECTIONS = "section Parameters, expected one or two lines without sections"


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("def f(x): ...", ["f: no docstring"]),
        (made("def f(x: FloatArray):"), []),
        (made("def f(x):", "Parameters x: it"), [f"f: {SECTIONS}"]),
        (made("def f():", "Raises InputError: it"), [f"f: {SECTIONS.replace('Parameters', 'Raises')}"]),
        (made("def _f(x):", "Parameters x: it"), [f"_f: {SECTIONS}"]),
        (made(DATACLASS, "Attributes x: it", body="x: int"), [f"C: {SECTIONS.replace('Parameters', 'Attributes')}"]),
        (
            made("class C:", body=made("def f(self, x):", "Parameters x: it").replace("\n", "\n    ")),
            [f"C.f: {SECTIONS}"],
        ),
        (
            made("class _C:", body=made("def f(self, x):", "Parameters x: it").replace("\n", "\n    ")),
            [f"_C.f: {SECTIONS}"],
        ),
        (made("class _C:", body="def f(self, x): ..."), []),
        (made("class C:", body="@property\n    def p(self): ..."), ["C.p: no docstring"]),
        (made("def f():", first="One.\n\n    Two.\n    Three."), []),
        (made("def f():", first="One.\n\n    Two.\n    Three.\n    Four."), ["f: 4 lines, expected at most 3"]),
        ("__all__ = ['f']\n\ndef f(): ...\n\ndef g(): ...", ["f: no docstring"]),
    ],
)
def test_it_finds_what_is_too_much_inside(code: str, found: list[str], tmp_path: Path) -> None:
    assert list(findings(loaded(tmp_path, "msg_analysis.report.made", HEAD + code), Api())) == found


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("def f(x): ...", ["f: no docstring"]),
        (made("def f(x: FloatArray) -> FloatArray:"), []),
        (made("def f(x, y):", "Parameters x: it"), ["f: y: not documented"]),
        (made("def f(x: FloatArray):", "Parameters x: it"), ["f: x: no shape in 'it'"]),
        (made("def f(x):", "Parameters x: it", "Parameters y: it"), ["f: y: documented, but no argument"]),
        (made("def f() -> FloatArray:", "Returns FloatArray: errors"), ["f: no shape of what it returns"]),
        (made("def f():", "Parameters x: it", first="One.\n\n    Two.\n    Three.\n    Four."), []),
    ],
)
@pytest.mark.parametrize("folder", ["inference", "inference.errors", "mentioned"])
def test_it_finds_sections_that_are_not_complete(folder: str, code: str, found: list[str], tmp_path: Path) -> None:
    path = f"msg_analysis.{folder}.made"
    api = Api(mentioned=[f"{path}.f"] if folder == "mentioned" else [])
    assert list(findings(loaded(tmp_path, path, HEAD + code), api)) == found


@pytest.mark.parametrize("folder", ["theory", "theory.solvers"])
@pytest.mark.parametrize(
    ("head", "words", "found"),
    [
        ("Made.", "Do.", ["f: no source"]),
        ("Made.", "Proposition 3.", []),
        ("Solvers after Somebody and others (1984).", "Do.", []),
    ],
)
def test_it_finds_theory_without_a_source(folder: str, head: str, words: str, found: list[str], tmp_path: Path) -> None:
    code = f'"""{head}"""\n\ndef f():\n    """{words}"""'
    assert list(findings(loaded(tmp_path, f"msg_analysis.{folder}.made", code), Api())) == found


@pytest.mark.parametrize(
    ("path", "count", "last", "most"),
    [
        ("msg_analysis.report.made", 0, "", None),
        ("msg_analysis.report.made", 6, "End.", None),
        ("msg_analysis.report.made", 7, "End.", 6),
        ("msg_analysis.model.made", 12, "x(k+1) = W x(k)", None),
        ("msg_analysis.model.made", 13, "x(k+1) = W x(k)", 12),
        ("msg_analysis.theory.solvers.made", 12, "End.", None),
        ("msg_analysis.messages.made", 13, "End.", 12),
        ("msg_analysis.wired.made", 12, "End.", 6),
        ("msg_analysis.public", 12, "End.", None),
    ],
)
def test_it_finds_modules_with_long_docstrings(
    path: str, count: int, last: str, most: int | None, tmp_path: Path
) -> None:
    text = "\n\n".join([*["Line."] * (count - 1), last])
    expected = [] if most is None else [f"module: {count} lines, expected at most {most}"]
    if not count:
        text, expected = "", ["module: no docstring"]
    module = loaded(tmp_path, path, f'"""{text}"""' if text else "X = 1")
    assert list(findings(module, Api(modules=["msg_analysis.public"]))) == expected
