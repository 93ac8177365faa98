"""The types of a foreign bag: what is not an installed message is named, and nothing is imported for it."""

import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from rclpy.exceptions import InvalidTopicNameException
from rclpy.validate_full_topic_name import validate_full_topic_name

from msg_agents.nodes.player import message_classes
from msg_agents.nodes.ros import foreign_message_class
from msg_agents.replay import parse_remaps
from msg_analysis.bags.playback import BagTopic
from msg_analysis.errors import InputError

ODD = [
    *("", "/", "//", "std_msgs", "std_msgs/msg", "std_msgs/String", "std_msgs/msg/", "/msg/String", "../msg/String"),
    *("std_msgs/msg/Nope", "std_msgs/msg/string", "std_msgs/msg/_string", "std_msgs/msg/__doc__", "rclpy/msg/X"),
    *("std_msgs/msg/String/x", ".std_msgs/msg/String", "std_msgs /msg/String", "std_msgs/msg/String\n"),
    *("std_srvs/srv/Empty", "std_msgs::msg::dds_::String_", "std_msgs/msg/\x1b[2JString", "\0/msg/X", "a" * 10_000),
    *("this/msg/X", "this/that/X", "idlelib/idle/X", "unittest/__main__/X", "os/path/join", "numpy/random/Generator"),
    *("msg_agents/msg/X", "__main__/msg/X", "builtins/msg/X", "std_msgs/msg/Ștring"),
]

pytestmark = pytest.mark.filterwarnings("ignore:module .sre_:DeprecationWarning")  # of a package that rclpy imports


def topic(name: str, type_name: str) -> BagTopic:
    return BagTopic(name, type_name, "cdr", "", False, 1)


def classes(topics: list[BagTopic], notes: list[str], *, all_wanted: bool = False) -> dict[str, Any]:
    names = {each.name: each.name for each in topics}
    return message_classes(topics, names, all_wanted=all_wanted, on_note=notes.append)


def test_odd_types() -> None:
    notes: list[str] = []
    good = topic("/good", "std_msgs/msg/String")
    classes([good], notes, all_wanted=True)
    before = set(sys.modules)
    topics = [topic(f"/t{number}", type_name) for number, type_name in enumerate(ODD)]
    found = classes([*topics, good], notes)
    assert [(name, kind.__name__) for name, kind in found.items()] == [("/good", "String")]
    assert [note.partition(" (the type ")[0] for note in notes] == [f"not played: /t{n}" for n in range(len(ODD))]
    assert all(note.isprintable() and len(note) < 150 for note in notes)
    assert set(sys.modules) == before
    for each in topics:
        with pytest.raises(InputError, match="install missing types"):
            classes([each], notes)


NAMES = [
    *("/a", "/_a/b_1/__", "/" + "a" * 246, "/" + "a" * 247, "/", "//", "/a//b", "/a/", "/1a", "/a/1", "/a b", "/a-b"),
    *("/~x", "/~/x", "/a{b}", "/{node}", "/é", "/a\nb", "/a\n", "/\x1b[2J", "/a.b", "/A"),
]


@pytest.mark.parametrize("name", NAMES)
def test_names_of_topics(name: str) -> None:
    """What rclpy refuses is named in one line; such a topic of a bag can be played under another name."""
    string, notes = "std_msgs/msg/String", list[str]()
    topics, there = [topic(name, string), topic("/good", string)], ["/good", name]
    try:
        validate_full_topic_name(name)
    except InvalidTopicNameException:
        there.remove(name)
        with pytest.raises(InputError, match=r"^--remap: [^\n]*: not a name of a topic") as refused:
            parse_remaps([f"/good:={name}"], ["/good"])
        notes.append(str(refused.value))
    assert sorted(classes(topics, notes)) == sorted(there)
    assert len(notes) == 2 * (name not in there)
    assert all(note.isprintable() for note in notes)
    names = {name: "/other", "/good": "/good"}
    assert len(message_classes(topics, names, all_wanted=True, on_note=notes.append)) == 2


@pytest.mark.parametrize("listed", ["msg/X.idl", "msg/Y.idl", None])
def test_only_what_an_installation_registers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listed: str | None
) -> None:
    """A package like one of interfaces, on the path: not without the index, and not from another place than that."""
    here, there = tmp_path / "here", tmp_path / "there"
    for prefix, package in ((here, "here_msgs"), (there, "there_msgs")):
        (prefix / package / "msg").mkdir(parents=True)
        (prefix / package / "__init__.py").write_text(f"open({str(tmp_path / package)!r}, 'w').close()")
        (prefix / package / "msg/__init__.py").write_text("class X: pass")
        monkeypatch.syspath_prepend(prefix)
        index = here / "share/ament_index/resource_index/rosidl_interfaces"
        index.mkdir(parents=True, exist_ok=True)
        if listed is not None:
            (index / package).write_text(f"msg/Z.idl\n{listed}")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{here}")
    with pytest.raises(InputError, match=r'"here_msgs/msg/X" (cannot be loaded|is not installed here)') as refused:
        foreign_message_class("here_msgs/msg/X")
    assert ("cannot be loaded" in str(refused.value)) == (listed == "msg/X.idl") == (tmp_path / "here_msgs").exists()
    with pytest.raises(InputError, match="is not installed here"):
        foreign_message_class("there_msgs/msg/X")
    assert not (tmp_path / "there_msgs").exists()
    sys.modules.pop("here_msgs", None)
    sys.modules.pop("here_msgs.msg", None)
