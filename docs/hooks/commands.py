"""MkDocs hook: the comment ``<!-- help: msg-analysis msg-agents -->`` becomes the help of all commands of these two."""

from __future__ import annotations

import re
from html import escape
from typing import Any

import click

from msg_agents.cli.main import main as agents
from msg_analysis.cli.main import main as analysis

COMMENT = re.compile(r"<!-- help: ([\w -]+) -->")
PROGRAMS: dict[str, click.Group] = {"msg-agents": agents, "msg-analysis": analysis}
WIDTH = 100  # characters


def help_texts(program: str) -> dict[str, str]:
    """What ``--help`` prints, by command."""
    group = PROGRAMS[program]
    parent = click.Context(group, info_name=program, **group.context_settings)
    texts = {}
    for name, command in group.commands.items():
        context = click.Context(command, parent, name, terminal_width=WIDTH, max_content_width=WIDTH)
        texts[f"{program} {name}"] = command.get_help(context)
    return texts


def on_page_content(html: str, **_: Any) -> str:
    """Put the help of each command where the page has the comment."""

    def shown(match: re.Match[str]) -> str:
        texts = {name: text for program in match[1].split() for name, text in help_texts(program).items()}
        return "".join(
            f"<details><summary><code>{name}</code></summary><pre><code>{escape(text)}</code></pre></details>"
            for name, text in texts.items()
        )

    return COMMENT.sub(shown, html)
