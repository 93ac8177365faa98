"""Every command of both command lines, and each of them in this process."""

import re
from pathlib import Path

import click
from click.testing import CliRunner, Result

from msg_agents.cli.main import main as agents
from msg_analysis.cli.main import main as analysis

PROGRAMS: dict[str, click.Group] = {"msg-analysis": analysis, "msg-agents": agents}
COMMANDS = [(program, name) for program, group in PROGRAMS.items() for name in group.commands]


def run(program: str, *words: object, **environment: str) -> Result:
    """A command line: exit code, stdout, stderr. A process of its own takes a hundred times as long."""
    return CliRunner(env=environment).invoke(PROGRAMS[program], [str(word) for word in words], prog_name=program)


def call(*words: object) -> Result:
    """The same of ``msg-analysis``."""
    return run("msg-analysis", *words)


def command_of(program: str, name: str) -> click.Command:
    return PROGRAMS[program].commands[name]


def context_of(program: str, name: str) -> click.Context:
    group = PROGRAMS[program]
    return click.Context(
        command_of(program, name), info_name=name, parent=group.make_context(program, ["-h"], resilient_parsing=True)
    )


def without_progress(stderr: str) -> str:
    """What is on stderr besides the lines that long work writes there every ten seconds, on a slow machine too."""
    return re.sub(r"^[^:\n]+(: [a-z ]+)?: \d+ (of \d+|%).*\n", "", stderr, flags=re.M)


FOREIGN_NAMES = (  # of Python, libraries and our own, which commands and their workers import; most of them late
    *("signal", "random", "queue", "select", "platform", "selectors", "tempfile", "socket", "struct", "logging"),
    *(
        "subprocess",
        "multiprocessing",
        "pickle",
        "ctypes",
        "yaml",
        "numpy",
        "scipy",
        "pyarrow",
        "rclpy",
        "setproctitle",
    ),
    *("msg_analysis", "msg_agents", "sitecustomize"),
)


def put_foreign_files(folder: Path, executed: Path) -> None:
    """Files of these names, which leave their name in the file ``executed``."""
    for name in FOREIGN_NAMES:
        (folder / f"{name}.py").write_text(f"open({str(executed)!r}, 'a').write('{name} ')")
