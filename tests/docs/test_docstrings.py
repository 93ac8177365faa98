"""Everything public says what it takes, gives and refuses: arguments, shapes, units, errors, and theory its source.

Public is what has no underscore at the front of its name nor of its module's or class's, in msg_analysis and
msg_agents; of a module with ``__all__``, what that lists. Commands are documented by their --help (tests/commands).
What overrides a method of another package, or of a documented class of ours, may leave the words to that.
"""

from __future__ import annotations

import ast
import logging
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

import griffe
import pytest

ROOT = Path(__file__).parents[2]
SHAPE = re.compile(r"\([\w+*/^ .'-]+,[\w+*/^ .,'-]*\)|\bshape\b|\bscalar\b|\bone (?:for|per|a)\b|[Ss]ee ")
ARRAY = re.compile(r"\b(?:Float|Int|Bool|Any|Complex)Array\b|\bndarray\b|\bNDArray\b|\bArrayLike\b")
PHYSICAL = re.compile(  # names of arguments that are times or rates, whatever they are of
    r"(?:.*_)?(?:dt|duration|time|times|timeout|patience|period|seconds|rate|rates|stamp|delay|lateness)"
)
UNIT = re.compile(
    r"\[[^\]]+\]|\bs\b|\bms\b|\bns\b|\bHz\b|[Ss]econds?|nanoseconds?|simulated time|unit|steps?\b|[Ss]ee |whether",
    re.IGNORECASE,
)
SOURCE = re.compile(
    r"\bpaper\b|Proposition|Lemma|Theorem|Definition|docs/\w+\.md|\b[A-Z]\w+[^.]{0,70} \(?(?:19|20)\d\d\b"
)
NOT_TOLD = {
    "NotImplementedError",
    "AssertionError",
    "SystemExit",
    "AttributeError",
    "StopIteration",
    "KeyboardInterrupt",
}
ELSEWHERE = re.compile(
    r"^See |(?:[Pp]arameters|[Aa]rguments)[^.]{0,40}(?:see|as in|those of)|[Ss]ee \S+ for the parameters"
)
FOREIGN = re.compile(r"[Ss]ee [`:\w.]*(?:click|rclpy|numpy|ast|threading|logging|collections|contextlib|Protocol|http)")


def packages() -> dict[str, griffe.Module]:
    logging.getLogger("griffe").setLevel(logging.ERROR)
    found = {}
    for name, folder in (("msg_analysis", "analysis"), ("msg_agents", "msg_agents")):
        module = griffe.load(name, search_paths=[ROOT / folder], docstring_parser="numpy", allow_inspection=False)
        assert isinstance(module, griffe.Module)
        found[name] = module
    return found


PACKAGES = packages()


def modules(module: griffe.Module) -> Iterator[griffe.Module]:
    yield module
    for member in module.members.values():
        if isinstance(member, griffe.Module) and not member.name.startswith("_"):
            yield from modules(member)


MODULES = {module.path: module for package in PACKAGES.values() for module in modules(package)}


def is_command(function: griffe.Function) -> bool:
    return any(re.search(r"\bcommand\(|\bgroup\(", str(each.value)) for each in function.decorators)


def public(module: griffe.Module) -> Iterator[griffe.Function | griffe.Class]:
    for member in module.members.values():
        if member.is_alias or not isinstance(member, griffe.Function | griffe.Class):
            continue
        listed = member.name in module.exports if module.exports is not None else not member.name.startswith("_")
        if listed and not (isinstance(member, griffe.Function) and is_command(member)):
            yield from with_methods(member)


def with_methods(member: griffe.Function | griffe.Class) -> Iterator[griffe.Function | griffe.Class]:
    yield member
    if isinstance(member, griffe.Class):
        for inner in member.members.values():
            if (
                isinstance(inner, griffe.Function | griffe.Class)
                and not inner.is_alias
                and not inner.name.startswith("_")
            ):
                yield from with_methods(inner)


class Words:
    """A docstring taken apart."""

    def __init__(self, member: griffe.Object) -> None:
        docstring = member.docstring
        self.text = docstring.value if docstring else ""
        self.sections = docstring.parse("numpy", warnings=False) if docstring else []

    def described(self, *kinds: str) -> dict[str, str]:
        """Name of each argument (attribute, error) and what is said of it; several may share the words."""
        found: dict[str, str] = {}
        for section in self.sections:
            if section.kind.value in kinds:
                for entry in section.value:
                    for name in re.split(r",\s*", str(getattr(entry, "name", None) or entry.annotation)):
                        found[name.strip("`* ")] = entry.description or ""
        return found

    @property
    def result(self) -> str:
        """What is said of what comes back: by the first paragraph, or the sections about it."""
        parts = [self.text.split("\n\n")[0]]
        for section in self.sections:
            if section.kind.value in ("returns", "yields"):
                parts += [f"{entry.annotation} {entry.description}" for entry in section.value]
        return "\n".join(parts)


def arguments(member: griffe.Function | griffe.Class) -> dict[str, str]:
    """Name and annotation of every argument; of a class, of its constructor."""
    function = member
    if isinstance(member, griffe.Class):
        function = member.members.get("__init__") or member  # type: ignore[assignment]  # dataclasses have one, too
    if not isinstance(function, griffe.Function):
        return {}
    return {
        each.name.lstrip("*"): str(each.annotation or "")
        for each in function.parameters
        if each.name not in ("self", "cls") and not each.name.startswith("_")
    }


def raised(member: griffe.Function) -> set[str]:
    """Errors that its own body raises by name."""
    body = ast.parse(textwrap.dedent(member.source)).body
    if not body:  # made by a decorator
        return set()
    found: set[str] = set()
    waiting: list[ast.AST] = list(ast.iter_child_nodes(body[0]))
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.Lambda | ast.ClassDef):
            continue
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            name = ast.unparse(node.exc.func)
            if name[0].isupper() and name not in NOT_TOLD and name.split(".")[-1] != "Exit":
                found.add(name)
        waiting += ast.iter_child_nodes(node)
    return found


def overridden(member: griffe.Function) -> griffe.Function | None:
    """The method of a class of ours that this one takes the place of, if that says what it takes."""
    if not isinstance(member.parent, griffe.Class):
        return None
    for base in member.parent.mro():
        other = base.members.get(member.name)
        if isinstance(other, griffe.Function) and other.docstring and not base.path.startswith("builtins"):
            return other
    return None


def findings(member: griffe.Function | griffe.Class) -> Iterator[str]:
    words = Words(member)
    name = member.path.removeprefix(member.module.path + ".")
    if not words.text:
        yield f"{name}: no docstring"
        return
    if isinstance(member, griffe.Function) and (FOREIGN.search(words.text) or overridden(member)):
        return
    told = words.described("parameters", "other parameters", "attributes")
    given = arguments(member)
    if isinstance(member, griffe.Class):
        for base in member.mro():
            told = Words(base).described("parameters", "attributes") | told
    if ELSEWHERE.search(words.text):
        given = {}
    for argument, annotation in given.items():
        if not told.get(argument):
            yield f"{name}: {argument}: not documented"
            continue
        if ARRAY.search(annotation) and not SHAPE.search(told[argument]):
            yield f"{name}: {argument}: no shape in {told[argument]!r}"
        if (
            PHYSICAL.fullmatch(argument)
            and re.search(r"float|int|Array", annotation)
            and not UNIT.search(told[argument])
        ):
            yield f"{name}: {argument}: no unit in {told[argument]!r}"
    for argument in words.described("parameters", "other parameters"):
        if given and argument not in given:
            yield f"{name}: {argument}: documented, but no argument"
    if isinstance(member, griffe.Class):
        body = member.members.get("__init__")
        errors = raised(body) if isinstance(body, griffe.Function) else set()
    else:
        errors = raised(member)
        returns = str(member.returns or getattr(member, "annotation", "") or "")
        if ARRAY.search(returns) and "Callable" not in returns and not SHAPE.search(words.result):
            yield f"{name}: no shape of what it returns"
    for error in errors - words.described("raises").keys():
        yield f"{name}: raises {error}: not documented"
    if member.path.startswith("msg_analysis.theory.") and not any(SOURCE.search(text) for text in sources(member)):
        yield f"{name}: no source"


def sources(member: griffe.Object) -> Iterator[str]:
    """Where its source may be named: itself, its class, its module."""
    parent: griffe.Object | None = member
    while parent is not None and parent.path.count(".") >= 2:
        if parent.docstring:
            yield parent.docstring.value
        parent = parent.parent  # type: ignore[assignment]


@pytest.mark.parametrize("path", MODULES)
def test_public_names_are_documented(path: str) -> None:
    assert [found for member in public(MODULES[path]) for found in findings(member)] == []


def test_there_is_something_to_look_at() -> None:
    assert len(MODULES) > 120
    assert sum(1 for module in MODULES.values() for _ in public(module)) > 600


def made(signature: str, *sections: str, body: str = "") -> str:
    """Source of a function, or class, with a docstring of the given sections: "Parameters x: what it is"."""
    text = "Do."
    for section in sections:
        title, entry, words = re.fullmatch(r"(\w+) (\w+): (.*)", section).groups()  # type: ignore[union-attr]
        text += f"\n\n    {title}\n    {'-' * len(title)}\n    {entry}\n        {words}"
    return f'{signature}\n    """{text}\n    """\n    {body}\n'


@pytest.mark.parametrize(
    ("code", "found"),
    [
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
        (
            made("@dataclass\nclass C:", body="x: int").replace("@d", "from dataclasses import dataclass\n\n@d"),
            ["C: x: not documented"],
        ),
        (made("class C:", body="def f(self, x):\n        'Do.'"), ["C.f: x: not documented"]),
        (made("class C:", body="def _f(self, x): ..."), []),
        ("def _f(x): ...", []),
    ],
)
def test_the_test_finds_what_is_missing(code: str, found: list[str], tmp_path: Path) -> None:
    (tmp_path / "made.py").write_text(code)
    module = griffe.load("made", search_paths=[tmp_path], docstring_parser="numpy", allow_inspection=False)
    assert isinstance(module, griffe.Module)
    assert [each for member in public(module) for each in findings(member)] == found
