"""The rule of docs/contributing.md for docstrings: what is wrong with those of a module.

The public API is documented in full: arguments, shapes, units, errors. So is whatever has sections in theory/ and
inference/, and theory/ names its sources. All else has one to three lines without sections. Commands are documented by
their --help (tests/commands). Folders are matched by prefix, so that modules may move into folders below them.
"""

import ast
import functools
import logging
import re
import textwrap
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import griffe

ROOT = Path(__file__).parents[2]
FOLDERS = {"msg_analysis": "analysis", "msg_agents": "msg_agents"}  # of the packages
API_MODULES = "msg_analysis", "msg_analysis.protocol", "msg_agents"  # with ``__all__``; docs/api.md names the rest
API_NAME = re.compile(r"^::: ([\w.]+)", re.MULTILINE)
THEORY = "msg_analysis.theory"
FORMULAS = THEORY, "msg_analysis.inference"  # where functions that implement a formula have sections
LONG = *FORMULAS, "msg_analysis.messages"  # where modules may have a long docstring without a formula in it
MOST_LINES = 3  # of a docstring inside; blank lines do not count
MOST_MODULE_LINES, MOST_LONG_MODULE_LINES = 6, 12
FORMULA = re.compile(r"^ *\S.* = \S", re.MULTILINE)
SECTION = re.compile(
    r"^(Parameters|Other Parameters|Returns|Yields|Receives|Raises|Warns|Attributes|Methods)\n-{3,}$", re.MULTILINE
)
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
NOT_DOCUMENTED = {
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

Member = griffe.Function | griffe.Class | griffe.Attribute  # of attributes, the properties


def under(path: str, folders: Collection[str]) -> bool:
    """Whether a path is one of these, or below one."""
    return any(path == folder or path.startswith(f"{folder}.") for folder in folders)


def lines(text: str) -> int:
    return sum(1 for line in text.splitlines() if line.strip())


def modules(module: griffe.Module) -> Iterator[griffe.Module]:
    yield module
    for member in module.members.values():
        if isinstance(member, griffe.Module) and not member.name.startswith("_"):
            yield from modules(member)


def is_command(member: Member) -> bool:
    decorators = member.decorators if isinstance(member, griffe.Function) else []
    return any(re.search(r"\bcommand\(|\bgroup\(", str(each.value)) for each in decorators)


def members(parent: griffe.Module | griffe.Class, listed: bool = True) -> Iterator[tuple[Member, bool]]:
    """Functions, classes, methods and properties, and whether each is public: by its own name and its class's."""
    exports = parent.exports if isinstance(parent, griffe.Module) else None
    for member in parent.members.values():
        if not isinstance(member, Member) or is_command(member):  # a module, or an imported name
            continue
        public = listed and (member.name in exports if exports is not None else not member.name.startswith("_"))
        if not isinstance(member, griffe.Attribute) or "property" in member.labels:
            yield member, public
        if isinstance(member, griffe.Class):
            yield from members(member, public)


class Words:
    """A docstring taken apart."""

    def __init__(self, member: griffe.Object) -> None:
        docstring = member.docstring
        self.text = docstring.value if docstring else ""
        self.sections = docstring.parse("numpy", warnings=False) if docstring else []

    def described(self, *kinds: str) -> dict[str, str]:
        """Name of each argument (attribute, error) and its description; several may share one."""
        found: dict[str, str] = {}
        for section in self.sections:
            if section.kind.value in kinds:
                for entry in section.value:
                    for name in re.split(r",\s*", str(getattr(entry, "name", None) or entry.annotation)):
                        found[name.strip("`* ")] = entry.description or ""
        return found

    @property
    def result(self) -> str:
        """Description of the result: the first paragraph, and the sections about it."""
        parts = [self.text.split("\n\n")[0]]
        for section in self.sections:
            if section.kind.value in ("returns", "yields"):
                parts += [f"{entry.annotation} {entry.description}" for entry in section.value]
        return "\n".join(parts)


def arguments(member: Member) -> dict[str, str]:
    """Name and annotation of every argument; of a class, of its constructor."""
    function: object = member
    if isinstance(member, griffe.Class):
        function = member.members.get("__init__")  # dataclasses have one, too
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
            if name[0].isupper() and name not in NOT_DOCUMENTED and name.split(".")[-1] != "Exit":
                found.add(name)
        waiting += ast.iter_child_nodes(node)
    return found


def overridden(member: Member) -> griffe.Function | None:
    """The documented method of a class of ours that this one overrides."""
    if not isinstance(member, griffe.Function) or not isinstance(member.parent, griffe.Class):
        return None
    for base in member.parent.mro():
        other = base.members.get(member.name)
        if isinstance(other, griffe.Function) and other.docstring and not base.path.startswith("builtins"):
            return other
    return None


def missing(member: Member) -> Iterator[str]:
    """What a full docstring lacks: arguments, shapes, units, errors."""
    words = Words(member)
    if FOREIGN.search(words.text) or overridden(member):
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
            yield f"{argument}: not documented"
            continue
        if ARRAY.search(annotation) and not SHAPE.search(told[argument]):
            yield f"{argument}: no shape in {told[argument]!r}"
        if (
            PHYSICAL.fullmatch(argument)
            and re.search(r"float|int|Array", annotation)
            and not UNIT.search(told[argument])
        ):
            yield f"{argument}: no unit in {told[argument]!r}"
    for argument in words.described("parameters", "other parameters"):
        if given and argument not in given:
            yield f"{argument}: documented, but no argument"
    if isinstance(member, griffe.Class):
        body = member.members.get("__init__")
        errors = raised(body) if isinstance(body, griffe.Function) else set()
    else:
        errors = raised(member) if isinstance(member, griffe.Function) else set()
        returns = str(member.returns if isinstance(member, griffe.Function) else member.annotation)
        if ARRAY.search(returns) and "Callable" not in returns and not SHAPE.search(words.result):
            yield "no shape of what it returns"
    for error in sorted(errors - words.described("raises").keys()):
        yield f"raises {error}: not documented"


def too_much(text: str) -> Iterator[str]:
    """What does not belong into a docstring inside."""
    for match in SECTION.finditer(text):
        yield f"section {match.group(1)}, expected one or two lines without sections"
    if lines(text) > MOST_LINES and not SECTION.search(text):
        yield f"{lines(text)} lines, expected at most {MOST_LINES}"


def sources(member: griffe.Object) -> Iterator[str]:
    """Where its source may be named: itself, its class, its module."""
    parent: griffe.Object | None = member
    while parent is not None:
        if parent.docstring:
            yield parent.docstring.value
        parent = None if isinstance(parent, griffe.Module) else parent.parent


@dataclass(frozen=True)
class Api:
    """Paths of what users may use."""

    modules: Collection[str] = ()
    full: Collection[str] = ()  # functions and classes, which must be documented in full; with the bases of classes
    mentioned: Collection[str] = ()  # classes in their signatures and attributes, which may be documented in full


def findings(module: griffe.Module, api: Api) -> Iterator[str]:
    """Everything in a module that breaks the rule."""
    for finding in of_module(module, api):
        yield f"module: {finding}"
    for member, public in members(module):
        for finding in of_member(member, public, api):
            yield f"{member.path.removeprefix(module.path + '.')}: {finding}"


def of_module(module: griffe.Module, api: Api) -> Iterator[str]:
    text = Words(module).text
    if not text:
        yield "no docstring"
    long = under(module.path, LONG) or module.path in api.modules or FORMULA.search(text)
    most = MOST_LONG_MODULE_LINES if long else MOST_MODULE_LINES
    if lines(text) > most:
        yield f"{lines(text)} lines, expected at most {most}"


def of_member(member: Member, public: bool, api: Api) -> Iterator[str]:
    text, formulas = Words(member).text, under(member.module.path, FORMULAS)
    if public and not text:
        yield "no docstring"
    elif public and under(member.path, api.full):
        yield from missing(member)
    elif formulas or (public and under(member.path, api.mentioned)):
        if public and SECTION.search(text):
            yield from missing(member)
    else:
        yield from too_much(text)
    if public and under(member.path, [THEORY]) and not any(SOURCE.search(words) for words in sources(member)):
        yield "no source"


def packages() -> griffe.ModulesCollection:
    logging.getLogger("griffe").setLevel(logging.ERROR)
    collection = griffe.ModulesCollection()
    for name, folder in FOLDERS.items():
        griffe.load(
            name,
            search_paths=[ROOT / folder],
            docstring_parser="numpy",
            allow_inspection=False,
            modules_collection=collection,
        )
    return collection


def found_at(path: str, collection: griffe.ModulesCollection) -> griffe.Object:
    """The object of a path, not where it is imported but where it is written."""
    member = collection[path]
    return member.final_target if isinstance(member, griffe.Alias) else member


def with_bases(member: griffe.Object) -> Iterator[griffe.Object]:
    """A class and those that it inherits from; of a module, everything public in it."""
    yield member
    if isinstance(member, griffe.Class):
        yield from (base for base in member.mro() if not base.path.startswith("builtins"))
    if isinstance(member, griffe.Module):
        yield from (inner for inner, public in members(member) if public)


def types_of(member: griffe.Object) -> Iterator[griffe.Expr]:
    """Annotations of the arguments and the result of a function, or of the attributes and methods of a class."""
    given: list[object] = []
    if isinstance(member, griffe.Function):
        given = [member.returns, *(each.annotation for each in member.parameters)]
    elif isinstance(member, griffe.Attribute):
        given = [member.annotation]
    elif isinstance(member, griffe.Class):
        for inner in member.members.values():
            if isinstance(inner, griffe.Function | griffe.Attribute) and not inner.name.startswith("_"):
                yield from types_of(inner)
    yield from (each for each in given if isinstance(each, griffe.Expr))


def mentioned(member: griffe.Object, collection: griffe.ModulesCollection) -> Iterator[str]:
    """Classes of ours in the annotations of a member."""
    for annotation in types_of(member):
        for name in annotation.iterate(flat=True):
            if isinstance(name, griffe.ExprName) and under(name.canonical_path, API_MODULES):
                found = found_at(name.canonical_path, collection)
                if isinstance(found, griffe.Class):
                    yield found.path


def public_api(collection: griffe.ModulesCollection, page: str) -> Api:
    """What the packages export, and what docs/api.md names."""
    names = [f"{module}.{name}" for module in API_MODULES for name in collection[module].exports or []]
    found = [each for name in names + API_NAME.findall(page) for each in with_bases(found_at(name, collection))]
    return Api(
        modules={*API_MODULES, *(each.path for each in found if isinstance(each, griffe.Module))},
        full={each.path for each in found if not isinstance(each, griffe.Module)},
        mentioned={path for each in found for path in mentioned(each, collection)},
    )


@dataclass(frozen=True)
class Written:
    """What is in the packages."""

    collection: griffe.ModulesCollection
    modules: dict[str, griffe.Module]
    api: Api


@functools.cache
def written() -> Written:
    collection = packages()
    found = {module.path: module for name in FOLDERS for module in modules(collection[name])}
    return Written(collection, found, public_api(collection, (ROOT / "docs/api.md").read_text(encoding="utf-8")))
