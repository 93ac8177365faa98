"""Logs of others, with maps, definitions and messages that nobody should write: one error, or a right answer.

A third of the cases has a damaged map of a right bag or table; a third a definition that is damaged, or made to take
long; a third random types with random values, which rosbags writes and reads: both must find the same numbers.
Code that is made or run while a map or bag is read is a finding (audit events), and so is a warning of numpy.
"""

from __future__ import annotations

import io
import math
import random
import re
import struct
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mcap.writer
import numpy as np
import yaml
from fuzz_documents import BOMB, mutate_document, mutate_text
from rich.console import Console
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from msg_analysis.bags.first_map import check_log, first_map
from msg_analysis.bags.log_map import load_map, parse_map
from msg_analysis.bags.mapped_log import read_log
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.report.log_text import print_log_check, print_log_comparison

LAW = Experiment.parse(
    {
        "name": "fuzz",
        "names": ["ann", "bob", "cid"],
        "graphs": {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}},
        "switching": {"generator": [[-1, 1], [1, -1]]},
    }
)
START = 1_760_000_000_000_000_000  # ns
SAMPLES = 60
TANK = "lab_msgs/msg/Tank"
NUMBERS = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "float32": "f",
    "float64": "d",
    **{f"int{bits}": code for bits, code in zip((8, 16, 32, 64), "bhiq", strict=True)},
    **{f"uint{bits}": code for bits, code in zip((8, 16, 32, 64), "BHIQ", strict=True)},
}
IN_IDL = {"bool": "boolean", "byte": "octet", "char": "uint8", "float32": "float", "float64": "double"}
MAPS: list[dict[str, Any]] = [
    {
        "agents": {"*": {"topic": "/robot_{i}/pose", "field": "pose.position.x"}},
        "graph": {"topic": "/network/active", "field": "data"},
        "measurement_noise": 0.1,
    },
    {
        "agents": {
            i: {"topic": f"/robot_{i}/pose", "fields": ["pose.position.x", "pose.position.y"]} for i in (1, 2, 3)
        },
        "time": "log",
        "period": 0.1,
        "graph": {"fixed": "ring"},
        "units": {"time": 1.0, "state": 0.5},
        "measurement_noise": [0.1, 0.2, 0.1],
        "law": "continuous",
    },
    {
        "agents": {"*": {"topic": "/robot_{i}/pose", "field": "pose.orientation.w"}},
        "graph": {"file": "trace.csv", "undirected": True},
        "measurement_noise": "estimate",
        "law": "steps",
    },
    {"agents": {"*": {"field": "x{i}"}}, "time": "t", "graph": {"field": "graph"}},
    {"agents": {"ann": {"field": "x1"}, "*": {"fields": ["x{i}"]}}, "time": "t", "graph": {"file": "schedule.csv"}},
]
WRONG = [  # values of maps that take long, lead elsewhere, or look like code
    *(1e-300, 5e-324, 1e99, -1.0, 2**62, 2**70, 1e-9, 1e9, "1e9", float("nan"), float("inf"), "estimate", "continuous"),
    *("/robot_.*", "/robot_[0-9]+/pose", "(a+)+$", "{i}" * 100, "{name}", "*", "/robot_1/pose", "x1", "t", "data[999]"),
    *("/etc/passwd", "../../../etc/shadow", "/dev/zero", "/dev/stdin", "fifo", ".", "~", "file:///etc/passwd", "a\0b"),
    *("__class__.__mro__[1]", "os.system('touch hacked')", "{0.__class__}", "=cmd|' /C x'!A0"),
    *("%(x)s", "$HOME", "`id`"),
    *("header.stamp.sec", "header.frame_id", "pose", "pose.position", "[0]", "pose..x", "x" * 100_000, "\u202e", "²"),
    *([0.1] * 100_000, [[]], {"topic": "/robot_1/pose", "field": "pose.position.x"}, ["x1"] * 200, ["x1", "{i}"]),
]
KEYS = [1, 0, -1, 2.5, True, None, "1", "01", "²", "٣", "*", "", "9" * 30, 2**32 - 1, 10**8, 2**70, "ann", "x" * 300]


def write_sources(folder: Path) -> list[Path]:
    """A bag and a table of random walks, and the traces that the maps name."""
    store, rng = get_typestore(Stores.ROS2_JAZZY), np.random.default_rng(1)
    types, kind, text = store.types, "geometry_msgs/msg/PoseStamped", "std_msgs/msg/String"
    states = np.cumsum(0.3 * rng.normal(size=(SAMPLES, 3)), axis=0)
    with (folder / "robots.mcap").open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start()
        channels = {}
        for name in (kind, text):
            definition, _ = store.generate_msgdef(name, ros_version=2)
            channels[name] = writer.register_schema(name, "ros2msg", definition.encode())
        network = writer.register_channel("/network/active", "cdr", channels[text])
        robots = [writer.register_channel(f"/robot_{i}/pose", "cdr", channels[kind]) for i in (1, 2, 3)]
        for k, row in enumerate(states.tolist()):
            time = START + k * 10**8
            if k % 20 == 0:
                data = bytes(store.serialize_cdr(types[text](("line", "ring")[k // 20 % 2]), text))
                writer.add_message(network, time, data, time)
            stamp = types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)
            for robot, value in zip(robots, row, strict=True):
                place = types["geometry_msgs/msg/Point"](value, -value, 0.0)
                turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, value)
                header = types["std_msgs/msg/Header"](stamp, "map" * (k % 3))
                pose = types[kind](header, types["geometry_msgs/msg/Pose"](place, turn))
                writer.add_message(robot, time, bytes(store.serialize_cdr(pose, kind)), time)
        writer.finish()
    rows = ["t,x1,x2,x3,graph"]
    rows += [f"{k / 10},{a},{b},{c},{('line', 'ring')[k // 20 % 2]}" for k, (a, b, c) in enumerate(states.tolist())]
    (folder / "robots.csv").write_text("\n".join(rows), encoding="utf-8")
    first, last = START / 1e9 - 1, START / 1e9 + 100
    links = [f"{first:.1f},{last:.1f},1,2", f"{first:.1f},{last:.1f},2,3", f"{first + 3:.1f},{last - 9:.1f},3,1"]
    (folder / "trace.csv").write_text("\n".join(["start,end,source,target", *links]), encoding="utf-8")
    (folder / "schedule.csv").write_text("time,graph\n-1,line\n3,ring\n", encoding="utf-8")
    sources = [folder / "robots.mcap", folder / "robots.csv"]
    for place, document in enumerate(MAPS):  # imports what is imported when it is needed
        (folder / "map.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
        assert _judge(sources[place > 2], folder / "map.yaml") == "disagrees"
    return sources


def fuzz_log(seed: int, sources: list[Path], folder: Path) -> str:
    """One log with a map; what came of it."""
    rng = random.Random(seed)
    with _watched():
        return (_fuzz_map, _fuzz_definition, _fuzz_values)[seed % 3](rng, sources, folder)


_watching = [False]


class CodeError(BaseException):
    """Code was made or run, or a program started, while a log was read. Nobody but us catches it."""


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watching[0]:
        return
    made = event == "compile" and str(arguments[1]).startswith("<")
    if made or event in ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pickle.find_class"):
        _watching[0] = False
        raise CodeError(f"{event} {str(arguments)[:200]}")


sys.addaudithook(_audit)


@contextmanager
def _watched() -> Iterator[None]:
    """No code is made or run within, and nothing warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _watching[0] = True
        try:
            yield
        finally:
            _watching[0] = False


@contextmanager
def _trusted() -> Iterator[None]:
    """For rosbags, which makes code of definitions (those here are our own)."""
    _watching[0] = False
    try:
        yield
    finally:
        _watching[0] = True


def _judge(log: Path, mapped: Path | None) -> str:
    """Check and compare a log; "refused" where neither gives an answer."""
    console = Console(file=io.StringIO(), width=100)
    outcome = "refused"
    try:
        checked = check_log(log, load_map(mapped) if mapped else None)
        print_log_check(checked, console)
        outcome = "checked"
    except InputError as error:
        _check_words(error)
    if mapped is None:
        return outcome
    try:
        comparison = read_log(log, load_map(mapped), LAW, mapped.parent).compare()
        document = comparison.to_json()
        print_log_comparison(document, console, verbose=True)
        _require_finite(document, "")
        outcome = str(document["verdict"])
    except InputError as error:
        _check_words(error)
    return outcome


def _require_finite(document: Any, key: str) -> None:
    """Numbers of an answer are numbers."""
    if isinstance(document, dict):
        for name, value in document.items():
            _require_finite(value, f"{key}.{name}")
    elif isinstance(document, list | tuple):
        for value in document:
            _require_finite(value, key)
    elif isinstance(document, float):
        assert math.isfinite(document), f"{key}: {document}"


def _check_words(error: InputError) -> None:
    """An error for people: some words, and not a book."""
    text = str(error)
    assert 10 < len(text) < 20_000, f"message of {len(text)} characters: {text[:300]}"


def _fuzz_map(rng: random.Random, sources: list[Path], folder: Path) -> str:
    place = rng.randrange(len(MAPS))
    bag, table = sources
    log = bag if place < 3 else table
    document = MAPS[place]
    what = rng.randrange(4)
    if what == 0:
        text = mutate_text(yaml.safe_dump(document, sort_keys=False), rng)
        if rng.random() < 0.05:
            text += rng.choice(
                [
                    BOMB,
                    "\nunits: &a {time: *a}\n",
                    "\nagents: {1: {field: x}}\nagents: {}\n",
                    "x: !!python/name:os.system\n",
                ]
            )
    else:
        for _ in range(rng.choice([1, 1, 2])):
            document = mutate_document(document, rng) if what == 1 else _wrong(document, rng)
        text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    for name in ("trace.csv", "schedule.csv"):
        (folder / name).write_bytes((bag.parent / name).read_bytes())
    (folder / "map.yaml").write_bytes(text.encode("utf-8", errors="surrogatepass"))
    return _judge(log, folder / "map.yaml")


def _wrong(document: Any, rng: random.Random) -> Any:
    """A map with a wrong value at any key, or another key."""
    document = yaml.safe_load(yaml.safe_dump(document))
    found = document
    if not isinstance(found, dict) or not found:
        return rng.choice(WRONG)
    if rng.random() < 0.4:  # a number that the map may have, of any size
        number = 10.0 ** rng.uniform(-12.0, 12.0)
        key = rng.choice(["period", "measurement_noise", "time", "state"])
        return document | ({key: number} if key in ("period", "measurement_noise") else {"units": {key: number}})
    while True:
        key = rng.choice(list(found))
        if isinstance(found[key], dict) and found[key] and rng.random() < 0.7:
            found = found[key]
            continue
        if rng.random() < 0.25:
            found[rng.choice(KEYS)] = found.pop(key) if rng.random() < 0.5 else found[key]
        else:
            alike = [each for each in WRONG if isinstance(each, str) is isinstance(found[key], str)]
            found[key] = rng.choice(alike if rng.random() < 0.8 else WRONG)
        return document


def write_bag(file: Path, encoding: str, definition: bytes, messages: list[bytes], times: list[int]) -> None:
    """Three topics of one type."""
    with file.open("wb") as stream:
        writer = mcap.writer.Writer(stream, chunk_size=2**16)
        writer.start()
        schema = writer.register_schema(TANK, encoding, definition)
        channels = [writer.register_channel(f"/tank_{i}", "cdr", schema) for i in (1, 2, 3)]
        for time, data in zip(times, messages, strict=True):
            for channel in channels:
                writer.add_message(channel, time, data, time)
        writer.finish()


HOSTILE: list[Callable[[random.Random], str]] = [
    lambda _: "lab_msgs/Tank tank\nfloat64 x",
    lambda _: "A a\nfloat64 x\n" + _also("A", "B b") + _also("B", "A a"),
    lambda _: "lab_msgs/A[] a\nfloat64 x\n" + _also("A", "lab_msgs/A[2] a"),
    lambda _: "other_msgs/Thing thing\nfloat64 x",
    lambda rng: f"float64[{rng.choice([0, 10**9, 2**31, 2**63, 2**64, 10**30])}] big\nfloat64 x",
    lambda rng: f"A[{10 ** rng.randrange(3, 10)}] a\nfloat64 x\n" + _also("A", "B[1000] b") + _also("B", "bool[0] c"),
    lambda rng: (
        "A0 a\nfloat64 x\n"
        + "".join(_also(f"A{k}", f"A{k + 1} a\nfloat64 x") for k in range(rng.choice([30, 100, 900])))
    ),
    lambda rng: _wide(rng.choice([3, 20, 200, 2000])),
    lambda rng: (
        "std_msgs/Header header\nfloat64 x\n"
        + _stamp(rng.choice(["string", "float64", "uint64", "int64", "bool", "int32[2]"]))
    ),
    lambda rng: "".join(f"float64 x{k}\n" for k in range(rng.choice([100, 3000, 10_000]))),
    lambda _: "string s\n" * 3 + "float64 x\nfloat64 x",
    lambda _: "float64 __class__\nfloat64 x\nfloat64 __import__('os').system('touch hacked')",
    lambda _: "# " + "x" * 200_000 + "\nfloat64 x",
    lambda rng: "[" * rng.choice([100, 10_000, 100_000]),
    lambda _: "float64 x " + "1" * 100_000,
    lambda _: "string<=99999999999999999999 s\nfloat64 x",
    lambda rng: 'string s "' + "\\" * rng.choice([11, 1001]) + "\nfloat64 x",
    lambda _: "wstring s\nfloat64 x",
    lambda _: "float64[<=3] h\nfloat64 x",
    lambda rng: "module lab_msgs { module msg { " * rng.choice([1, 50, 5000]) + "struct Tank { double x; };",
    lambda rng: _module("double x;", f"const long A = {'(' * rng.choice([5, 500, 50_000])}1;"),
    lambda rng: _module("double x[A];", f"const long A = 9 {'* 9' * rng.choice([5, 20, 5000])};"),
    lambda _: _module("S s; double x;", "typedef double T[1000]; typedef T S[1000];"),
    lambda _: _module("sequence<sequence<double>> s; double x;"),
    lambda _: "/*" * 1000 + _module("double x;"),
]


def _also(name: str, text: str) -> str:
    return f"\n{'=' * 80}\nMSG: lab_msgs/{name}\n{text}"


def _module(fields: str, before: str = "") -> str:
    return f"module lab_msgs {{ module msg {{ {before} struct Tank {{ {fields} }}; }}; }};"


def _wide(count: int) -> str:
    """Types that have many fields of the next one: count^4 numbers."""

    def fields(inner: str) -> str:
        return "\n".join(f"{inner} f{k}" for k in range(count))

    return (
        fields("A") + "\nfloat64 x" + _also("A", fields("B")) + _also("B", fields("C")) + _also("C", fields("float64"))
    )


def _stamp(kind: str) -> str:
    time = f"\n{'=' * 80}\nMSG: builtin_interfaces/Time\n{kind} sec\nuint32 nanosec"
    return f"\n{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id{time}"


def _fuzz_definition(rng: random.Random, _sources: list[Path], folder: Path) -> str:
    if rng.random() < 0.5:
        definition = rng.choice(HOSTILE)(rng)
        idl = definition.startswith(("module", "/*"))
    else:
        types = random_types(rng)
        idl = rng.random() < 0.5
        definition = mutate_text(in_idl(types) if idl else in_msg(types), rng)
    data = definition.encode("utf-8", errors="surrogatepass")
    if rng.random() < 0.03:
        data = rng.choice([rng.randbytes(300), data[: len(data) // 2], b"\xff" + data, definition.encode("utf-16")])
    encoding = rng.choice(["ros2idl" if idl else "ros2msg"] * 8 + ["ros2msg", "ros2idl", "", "protobuf"])
    size = rng.choice([0, 8, 24, 100, 3000])
    messages = [
        rng.choice([bytes(size), rng.randbytes(size), struct.pack("<dd", 1.0, 2.0) * (size // 16)])
        for _ in range(SAMPLES)
    ]
    head = rng.choice([b"\0\1\0\0"] * 6 + [b"\0\0\0\0", b"\0\7\0\0", b""])
    step = rng.choice([10**8] * 6 + [0, 1, 10**16])
    times = [rng.choice([START, START, 0]) + k * step for k in range(SAMPLES)]
    write_bag(folder / "tanks.mcap", encoding, data, [head + each for each in messages], times)
    fields = rng.choice(
        [["x"], ["x"], ["x"], ["f0.f0.f0.f0"], ["header.stamp.sec"], ["a.a.a.a.x"], ["s"], ["big[0]"], ["x[0]"]]
    )
    document = {"agents": {"*": {"topic": "/tank_{i}", "fields": fields}}, "graph": {"fixed": "ring"}}
    document |= {"time": rng.choice(["header", "log"]), "measurement_noise": rng.choice([0, 0.1, "estimate"])}
    (folder / "map.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    try:
        first_map(folder / "tanks.mcap")
    except InputError as error:
        _check_words(error)
    return _judge(folder / "tanks.mcap", rng.choice([None, folder / "map.yaml", folder / "map.yaml"]))


Types = dict[str, list[tuple[str, str, str]]]  # by name: kind, size ("", "[3]", "[]", "[<=3]"), field


def random_types(rng: random.Random) -> Types:
    """Types within types, the first of which is that of the messages."""
    names = ["Tank", *(f"T{k}" for k in range(rng.randrange(4)))]
    types: Types = {}
    for place, name in enumerate(names):
        kinds = [*NUMBERS, "string", "string", *names[place + 1 :] * 3]
        fields = [
            (rng.choice(kinds), rng.choice(["", "", "", "[3]", "[]", "[<=3]"]), f"f{k}")
            for k in range(rng.randrange(1, 7))
        ]
        types[name] = [*fields, ("float64", "", "x")]
    return types


def in_msg(types: Types) -> str:
    """The definition as ros2msg."""
    texts = []
    for name, fields in types.items():
        lines = [
            f"{kind if kind in NUMBERS or kind == 'string' else f'lab_msgs/{kind}'}{size} {field}"
            for kind, size, field in fields
        ]
        texts.append("\n".join(([] if name == "Tank" else [f"MSG: lab_msgs/{name}"]) + lines))
    return f"\n{'=' * 80}\n".join(texts)


def in_idl(types: Types) -> str:
    """The definition as ros2idl."""
    texts = []
    for name, fields in types.items():
        lines = []
        for kind, size, field in fields:
            idl = IN_IDL.get(kind, kind) if kind in NUMBERS or kind == "string" else f"lab_msgs::msg::{kind}"
            if size in ("", "[3]"):
                lines.append(f"{idl} {field}{size};")
            else:
                lines.append(f"sequence<{idl}{', 3' * (size != '[]')}> {field};")
        struct_ = f"struct {name} {{ {' '.join(lines)} }};"
        texts.append(f"{'=' * 80}\nIDL: lab_msgs/msg/{name}\nmodule lab_msgs {{ module msg {{ {struct_} }}; }};")
    return "\n".join(texts)


def _value(kind: str, size: str, types: Types, classes: Any, rng: random.Random) -> Any:
    """A random value of a field, as rosbags has it."""
    if size:
        count = 3 if size == "[3]" else rng.randrange(4)
        values = [_value(kind, "", types, classes, rng) for _ in range(count)]
        return np.array(values, dtype=np.dtype(NUMBERS[kind])) if kind in NUMBERS else values
    if kind == "string":
        return rng.choice(["", "a", "é", "map", "x" * rng.randrange(40)])
    if kind not in NUMBERS:
        return classes[f"lab_msgs/msg/{kind}"](*(_value(*field[:2], types, classes, rng) for field in types[kind]))
    if kind == "bool":
        return rng.random() < 0.5
    if kind.startswith("float"):
        return float(np.float32(rng.gauss(0.0, 10.0)))
    if kind in ("byte", "char"):
        return rng.randrange(128)  # rosbags packs them as int8
    limits = np.iinfo(np.dtype(NUMBERS[kind]))
    return rng.choice([int(limits.min), int(limits.max), rng.randint(int(limits.min), int(limits.max))])


def _leaves(kind: str, types: Types, path: str, rng: random.Random) -> Iterator[str]:
    """Paths of numbers."""
    for inner, size, field in types[kind]:
        index = f"[{rng.randrange(3)}]" if size else ""
        if inner in NUMBERS:
            yield f"{path}{field}{index}"
        elif inner != "string":
            yield from _leaves(inner, types, f"{path}{field}{index}.", rng)


def _look_up(message: Any, path: str) -> float | None:
    """The number at a path; None: a sequence is too short."""
    for part in re.findall(r"\w+", path):
        if part.isdigit():
            if int(part) >= len(message):
                return None
            message = message[int(part)]
        else:
            message = getattr(message, part)
    return float(message)


def _fuzz_values(rng: random.Random, _sources: list[Path], folder: Path) -> str:
    types = random_types(rng)
    idl = rng.random() < 0.5
    definition = in_idl(types) if idl else in_msg(types)
    with _trusted():
        store = get_typestore(Stores.EMPTY)
        plain = re.sub(r"(?m)^(=+|IDL: .*)$", "", definition)  # of definitions in IDL
        store.register(get_types_from_idl(plain) if idl else get_types_from_msg(definition, TANK))
        values = [_value("Tank", "", types, store.types, rng) for _ in range(SAMPLES)]
        little = rng.random() < 0.7
        messages = [bytes(store.serialize_cdr(each, TANK, little_endian=little)) for each in values]
    paths = list(dict.fromkeys(_leaves("Tank", types, "", rng)))
    paths = rng.sample(paths, min(len(paths), rng.choice([1, 1, 2, 3])))
    write_bag(
        folder / "tanks.mcap", "ros2idl" if idl else "ros2msg", definition.encode(), messages,
        [START + k * 10**8 for k in range(SAMPLES)],
    )  # fmt: skip
    document = {"agents": {"*": {"topic": "/tank_{i}", "fields": paths}}, "time": "log", "graph": {"fixed": "ring"}}
    document["units"] = {"state": 1e5}  # or numbers of 64 bits would be too large
    rows = [[_look_up(each, path) for path in paths] for each in values]
    kept = [row for row in rows if None not in row]
    if len(kept) < 2:  # an error; what it says is tested with the other cases
        return _judge(folder / "tanks.mcap", None)
    log = read_log(folder / "tanks.mcap", parse_map(document, "map"), LAW)
    for agent in range(3):
        assert np.array_equal(log.states[:, agent], np.array(kept) / 1e5), f"{paths}: other numbers than rosbags reads"
    return "equal"
