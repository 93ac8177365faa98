"""Hostile text: endless files, alias bombs, deep nesting; none costs time or memory."""

from __future__ import annotations

from pathlib import Path

import many_commands
import pytest
import yaml

from msg_analysis.common.files import DEEPEST, MOST_REPEATED, load_yaml, read_text


def bomb(levels: int) -> str:
    """A list of ten lists of ten lists ...; in a few hundred bytes."""
    lines = ["a0: &q0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &q{i} [{', '.join([f'*q{i - 1}'] * 10)}]" for i in range(1, levels)]
    return "\n".join(lines)


def test_aliases() -> None:
    """As in YAML, up to a limit of what they repeat."""
    assert load_yaml("a: &x [1, 2]\nb: [*x, *x]\nc: {<<: {d: *x}}", yaml.SafeLoader) == {
        "a": [1, 2], "b": [[1, 2], [1, 2]], "c": {"d": [1, 2]},
    }  # fmt: skip
    assert len(load_yaml(bomb(5), yaml.SafeLoader)) == 5
    with pytest.raises(yaml.MarkedYAMLError, match=f"aliases repeat more than {MOST_REPEATED} values"):
        load_yaml(bomb(7), yaml.SafeLoader)
    with pytest.raises(yaml.MarkedYAMLError, match="alias 'x' stands inside what it names"):
        load_yaml("a: &x [1, *x]", yaml.SafeLoader)
    with pytest.raises(yaml.YAMLError, match="undefined alias"):
        load_yaml("a: *x", yaml.SafeLoader)


def test_depth() -> None:
    assert load_yaml("[" * DEEPEST + "]" * DEEPEST, yaml.SafeLoader)
    for brackets in ("[", "{a: "):
        with pytest.raises(yaml.MarkedYAMLError, match="nested too deeply"):
            load_yaml(brackets * (DEEPEST + 1), yaml.SafeLoader)


def test_length(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("é" * 1000, encoding="utf-8")
    assert read_text(file, 2000) == "é" * 1000
    with pytest.raises(OSError, match="longer than 0 MB"):
        read_text(file, 1999)
    with pytest.raises(OSError, match="longer than 64 MB"):
        read_text(Path("/dev/zero"))


@pytest.mark.parametrize("command", ["info", "predict", "simulate", "compare", "tabulate", "sweep"])
@pytest.mark.parametrize("kind", ["bomb", "bomb of a bag", "endless"])
def test_commands(command: str, kind: str, tmp_path: Path) -> None:
    """One error, exit code 2, within 1 GB of memory."""
    path = tmp_path / "file"
    if kind == "endless":
        path = Path("/dev/zero")
    elif kind == "bomb":
        path.write_text(f"{bomb(9)}\ngraphs: {{g: {{path: *q8}}}}\n")
    else:
        path.mkdir()
        (path / "metadata.yaml").write_text(f"{bomb(9)}\nrosbag2_bagfile_information: {{files: *q8}}\n")
    out = ["--out", str(tmp_path / "out")] if command in ("simulate", "sweep") else []
    job = ["msg-analysis", [command, str(path), *out], "memory"]
    ((code, stdout, stderr),) = many_commands.outcomes([job], tmp_path, NO_COLOR="1")
    assert (code, stdout) == (2, ""), stderr
    assert stderr.startswith("error: ") or "Error: " in stderr
    assert "Traceback" not in stderr
    assert len(stderr) < 2000
