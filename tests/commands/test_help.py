"""What all commands of both command lines have in common: help, options, examples, start-up."""

import inspect
import itertools
import os
import re
import shlex
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from runpy import run_path

import click
import pytest
from programs import COMMANDS, PROGRAMS, command_of, context_of, run

import msg_analysis.bags.stored_file as storage_module
from msg_analysis.cli import options as cli_options
from msg_analysis.cli.console import SHORT_HELP
from msg_analysis.common.files import RESULT_FILE
from msg_analysis.inference.comparison import MAX_MISSED
from msg_analysis.inference.pool import compare
from msg_analysis.model.run import Run

DOCS = Path(__file__).parents[2] / "docs"
HOOK = run_path(str(DOCS / "hooks/commands.py"))
HEAVY = (
    *("numpy", "scipy", "networkx", "pydantic", "matplotlib", "rich", "jinja2", "yaml", "mcap", "zstandard", "lz4"),
    *("rclpy", "dask", "distributed", "pyarrow", "bokeh", "pandas"),
    *("msg_analysis.experiment.experiment", "msg_agents.run.runner"),
)
METAVARS = {  # of options that are called the same, wherever they are
    "--seed": {"N"},
    "--duration": {"T", "SECONDS"},  # of a run; of a bag that is played
    "--out": {"DIR", "BAG"},  # where something is made; the bag itself
    "--level": {"P"},
    "--domain": {"D"},
    "--restarts": {"N"},
    "--rate": {"HZ", "RATE"},
}
VAGUE = {"TEXT", "INTEGER", "FLOAT", "PATH", "FILENAME", "DIRECTORY", "INTEGER RANGE", "FLOAT RANGE"}


def options(program: str, name: str) -> list[click.Option]:
    return [each for each in command_of(program, name).params if isinstance(each, click.Option) and not each.hidden]


def long_name(option: click.Option) -> str:
    return max(option.opts, key=len)


def help_of(program: str, *words: str) -> str:
    result = run(program, *words, "--help", COLUMNS="80")
    assert (result.exit_code, result.stderr) == (0, "")
    return result.stdout


def example_lines(program: str, name: str) -> list[str]:
    _, _, lines = help_of(program, name).partition("Examples:\n")
    return [line.strip() for line in lines.splitlines() if line.strip()]


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_help(program: str, name: str) -> None:
    """In 80 columns, with examples and a word about every option; values are named, defaults are shown."""
    text = help_of(program, name)
    assert max(map(len, text.splitlines())) <= 80
    assert example_lines(program, name)
    assert re.match(r"  [A-Z][a-z]+\b", text.split("\n\n")[1]), "a verb first, no name of the code"
    context = context_of(program, name)
    for option in options(program, name):
        assert option.help, option.opts
        assert option.help[0].isupper(), option.help
        assert option.help.endswith("."), option.help
        metavar = option.make_metavar(context)
        assert option.is_flag or metavar not in VAGUE, option.opts
        assert option.is_flag or metavar in METAVARS.get(long_name(option), {metavar}), option.opts
        record = option.get_help_record(context) or ("", "")
        has_default = option.default not in (None, False, ()) and str(option.default) != "Sentinel.UNSET"
        assert not has_default or "default: " in record[1], option.opts
        assert "by default" not in option.help.lower() or option.is_flag, "is shown behind it"


def test_options_of_one_name_are_one_option() -> None:
    """Same kind of value; and where it is not a matter of the command, the same words."""
    kinds = defaultdict(set)
    helps = defaultdict(set)
    for program, name in COMMANDS:
        for option in options(program, name):
            kinds[long_name(option)].add((type(option.type).__name__, option.is_flag, option.multiple))
            helps[long_name(option)].add(option.help)
    several = {name: kind for name, kind in kinds.items() if len(kind) > 1}
    # A rate in Hz, or of a player; the duration of a run, or of a bag; the format of drawings, or of a table;
    # a table that is also written, or the format of what is; the number of agents, or some of them; the law of a
    # log, or one of several laws of the theory.
    assert set(several) == {"--rate", "--duration", "--format", "--csv", "--agents", "--law"}
    for name in ("--json", "--seed", "--compression", "--split-size", "--use-sim-time"):
        assert len(helps[name]) == 1, name


def test_overview_and_version() -> None:
    for program, group in PROGRAMS.items():
        text = help_of(program)
        assert max(map(len, text.splitlines())) <= 80
        for name in group.commands:
            assert re.search(rf"^  {name} +\S", text, re.MULTILINE), name
        version = run(program, "--version")
        assert re.fullmatch(rf"{program}, version \d+\.\d+\.\d+\n", version.stdout)


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_every_example_is_a_command_line(
    program: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is parsed and its values are checked, but nothing is run."""
    (tmp_path / "robots").mkdir()  # a bag
    monkeypatch.chdir(tmp_path)
    own = 0
    for line in example_lines(program, name):
        for part in re.split(r"[|>;]", re.sub(r" +#.*", "", line)):
            words = shlex.split(part)
            if not words or words[0] not in PROGRAMS:
                continue
            group = PROGRAMS[words[0]]
            context = group.make_context(words[0], words[1:])
            found, command, rest = group.resolve_command(context, words[1:])
            assert command
            command.make_context(found, rest, parent=context)
            own += (words[0], found) == (program, name)
    assert own


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_every_command_and_option_is_documented(program: str, name: str) -> None:
    """The command on a page; its options in the help that docs/hooks/commands.py puts into commands.md."""
    text = "".join(page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md")))
    assert f"`{program} {name}`" in text or f"`{name}`" in text
    assert HOOK["COMMENT"].findall(text) == [" ".join(PROGRAMS)] == ["msg-analysis msg-agents"]
    shown = HOOK["on_page_content"](f"<!-- help: {program} -->")
    (part,) = re.findall(rf"<summary><code>{program} {name}</code></summary>(.*?)</details>", shown, re.DOTALL)
    assert [each for each in map(long_name, options(program, name)) if not re.search(rf" {each}\b", part)] == []


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_list_of_commands_has_all_in_groups_and_cuts_nothing(program: str) -> None:
    """At most 55 letters of each, in a narrow terminal, too."""
    group = PROGRAMS[program]
    assert sorted(itertools.chain(*group.sections.values())) == sorted(group.commands)
    for width in ("80", "50"):
        text = run(program, "--help", COLUMNS=width).stdout
        assert "..." not in text.partition("Start here:")[2]
    for name, command in group.commands.items():
        sentence = " ".join((command.help or "").partition("\n\n")[0].split())
        assert f"{name:<10} {sentence}".split() in [line.split() for line in help_of(program).splitlines()]
        assert len(sentence) <= SHORT_HELP == 55, (name, sentence)
        assert sentence.endswith("."), name


def test_constants_of_options() -> None:
    """They stand beside the options because importing their modules takes longer than --help may take."""
    assert cli_options.COMPRESSIONS == storage_module.COMPRESSIONS
    assert cli_options.BAG_SUFFIXES == storage_module.BAG_SUFFIXES
    assert cli_options.SMALLEST_SPLIT == storage_module.SMALLEST_SPLIT
    assert cli_options.RESULT_FILE == RESULT_FILE
    (option,) = (one for one in PROGRAMS["msg-analysis"].commands["compare"].params if one.name == "max_missed")
    defaults = [inspect.signature(judge).parameters["max_missed"].default for judge in (compare, Run.compare)]
    assert [*defaults, option.default] == [MAX_MISSED] * 3


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_imports_nothing_heavy(program: str) -> None:
    """So every --help is there at once: docs/commands.md has the times."""
    module = "msg_agents.cli.main" if program == "msg-agents" else "msg_analysis.cli.main"
    code = (
        f"import sys\nfrom {module} import main\n"
        "for name in ['', *main.commands]:\n"
        "    main([name, '--help'] if name else ['--help'], standalone_mode=False)\n"
        f"    found = [module for module in {HEAVY!r} if module in sys.modules]\n"
        "    assert not found, (name, found)\n"
    )
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    process = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, env=environment)
    assert process.returncode == 0, process.stderr


@pytest.mark.parametrize(
    ("words", "suggestion"),
    [
        (["msg-analysis", "predcit"], "predict"),
        (["msg-analysis", "comapre", "bag"], "compare"),
        (["msg-agents", "rnu"], "run"),
        (["msg-agents", "switch"], "switcher"),
        (["msg-analysis", "simulate", "a.yaml", "--sed", "1"], "--seed"),
        (["msg-agents", "run", "a.yaml", "--proceses", "1"], "--processes"),
    ],
)
def test_a_slip_of_the_pen_is_told_the_nearest(words: list[str], suggestion: str) -> None:
    result = run(*words)
    assert (result.exit_code, result.stdout) == (2, "")
    assert re.search(rf"(Did you mean|Possible options).*{suggestion}", result.stderr)


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_wrong_usage(program: str, name: str) -> None:
    """Of every command: exit code 2, nothing on stdout, what is wrong and where to read on on stderr."""
    result = run(program, name, "--no-such-option")
    assert (result.exit_code, result.stdout) == (2, "")
    assert f"Try '{program} {name} --help' for help." in result.stderr
    assert "No such option '--no-such-option'" in result.stderr
