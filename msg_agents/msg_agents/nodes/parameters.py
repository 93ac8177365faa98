# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The options of a command that is a ROS 2 node, as parameters of its nodes.

An option is declared once, for the command line. Name, type, range, default and description of the ROS parameter follow
from it, and the same code checks what ``--ros-args -p`` or ``--params-file`` give. The command line takes precedence.
"""

from __future__ import annotations

import contextlib
import difflib
import itertools
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from msg_agents.environment import RANGE_VARIABLE, other_logs
from msg_analysis.errors import InputError

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor
    from rclpy.node import Node
    from rclpy.parameter import Parameter


# Parameters that have another name than the argument of the command's function.
NAMES = {"run_record": "run", "readers": "await", "subscribers": "wait_for_subscribers", "remaps": "remap"}
# Options that rclpy declares itself, that are used before there is a node, or that concern the terminal.
NO_PARAMETERS = {"use_sim_time", "domain", "as_json", "help"}
QOS_OVERRIDES = "qos_overrides"
ROS_OWN = {"use_sim_time", "start_type_description_service"}
GIVES_PARAMETERS = {"-p", "--param", "--params-file"}


@dataclass(slots=True)
class ProcessParameters:
    """The options of this process, for the nodes that it makes."""

    values: dict[str, Any] = field(default_factory=dict)  # by argument name in the command's function
    options: Sequence[click.Parameter] = ()  # those that are parameters
    qos_overrides: bool = False  # whether the arguments mention another quality of service
    _declarations: list[tuple[str, Any, ParameterDescriptor]] = field(default_factory=list, init=False)

    def declare(self, node: Node) -> None:
        """Declare all parameters on a node, with their values, for ``ros2 param`` and similar tools."""
        if not self._declarations:  # the same for every node of the process
            self._declarations = [
                (name_of(option), _ros_value(option, self.values.get(option.name or "")), describe(option))
                for option in self.options
            ]
        node.declare_parameters("", self._declarations, ignore_override=True)


PROCESS = ProcessParameters()  # a process has one command line


def options_of(command: click.Command) -> list[click.Parameter]:
    """The options and arguments of a command that are parameters of its nodes."""
    return [
        each
        for each in command.params
        if each.name not in NO_PARAMETERS and not (isinstance(each, click.Option) and each.hidden)
    ]


def name_of(option: click.Parameter) -> str:
    """Name of the parameter of an option."""
    name = option.name or ""
    return NAMES.get(name, name)


def describe(option: click.Parameter) -> ParameterDescriptor:
    """Type, range and description; all are read-only, because a node does not change during a run."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    kind = option.type
    descriptor = ParameterDescriptor(name=name_of(option), type=_type_of(option).value, read_only=True)
    descriptor.description = getattr(option, "help", None) or f"The same as the argument {option.human_readable_name}."
    if isinstance(kind, click.IntRange):
        most = 2**63 - 1 if kind.max is None else int(kind.max)
        descriptor.integer_range = [IntegerRange(from_value=int(kind.min or 0), to_value=most)]
    elif isinstance(kind, click.FloatRange):
        largest = sys.float_info.max if kind.max is None else float(kind.max)
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(kind.min or 0.0), to_value=largest)]
    elif isinstance(kind, click.Choice):
        descriptor.additional_constraints = f"one of {', '.join(kind.choices)}"
    return descriptor


def _type_of(option: click.Parameter) -> Parameter.Type:
    from rclpy.parameter import Parameter

    kind, several = option.type, bool(getattr(option, "multiple", False))
    if isinstance(kind, click.types.BoolParamType):
        return Parameter.Type.BOOL
    if isinstance(kind, click.types.IntParamType):
        return Parameter.Type.INTEGER_ARRAY if several else Parameter.Type.INTEGER
    if isinstance(kind, click.types.FloatParamType):
        return Parameter.Type.DOUBLE
    return Parameter.Type.STRING_ARRAY if several else Parameter.Type.STRING


def _ros_value(option: click.Parameter, value: Any) -> Any:
    """A value as rclpy takes it; its type if there is no value."""
    if value is None or value == ():
        return _type_of(option)
    if isinstance(value, tuple):
        return list(value)
    return str(value) if isinstance(value, Path) else value


@contextlib.contextmanager
def ros_arguments() -> Iterator[None]:
    """Around the start of rclpy: log files have a place, and wrong arguments for ROS 2 are an InputError."""
    os.environ.update(other_logs())
    from msg_agents.nodes.ros import RCLError

    try:
        yield
    except RCLError as error:
        found = re.search(r"failed to initialize rcl: (.*)", str(error), re.DOTALL)
        if not found:
            raise
        reason = re.sub(r"(, at \S+:\d+)+$", "", found[1].strip())
        raise InputError(f"--ros-args: {reason}") from error
    except RuntimeError as error:
        if type(error).__name__ != "UnknownROSArgsError":
            raise
        raise InputError(f"--ros-args: {error}: not an argument that ROS 2 knows") from error


def mention_qos(arguments: Sequence[str]) -> bool:
    """Whether arguments of ROS 2 (from ``--ros-args`` on) mention another quality of service, for any node."""
    if any(QOS_OVERRIDES in word for word in arguments):
        return True
    for option, file in itertools.pairwise(arguments):
        if option == "--params-file":
            with contextlib.suppress(OSError, UnicodeDecodeError):  # rcl reports the error
                if QOS_OVERRIDES in Path(file).read_text(encoding="utf-8"):
                    return True
    return False


def given(node_name: str, arguments: Sequence[str]) -> dict[str, Parameter]:
    """The parameters that arguments of ROS 2 (from ``--ros-args`` on) give to a node; InputError: rcl rejects them."""
    # Only rcl resolves namespaces and remappings, and only for a node: this makes one without discovery, in a context
    # of its own, and destroys it. ``os.environ`` is changed meanwhile.
    import rclpy
    from rclpy.context import Context
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions

    before = os.environ.get(RANGE_VARIABLE)
    os.environ[RANGE_VARIABLE] = "OFF"
    context = Context()
    try:
        with ros_arguments():
            rclpy.init(args=["", *arguments], context=context, signal_handler_options=SignalHandlerOptions.NO)
        try:
            node = Node(
                node_name,
                context=context,
                start_parameter_services=False,
                enable_rosout=False,
                allow_undeclared_parameters=True,
                automatically_declare_parameters_from_overrides=True,
            )
        except ValueError as error:  # an empty list has no type
            raise InputError("--ros-args: a parameter is an empty list: leave it out") from error
        found = dict(node.get_parameters_by_prefix(""))
        node.destroy_node()
    finally:
        context.try_shutdown()
        del os.environ[RANGE_VARIABLE]
        if before is not None:
            os.environ[RANGE_VARIABLE] = before
    return {name: parameter for name, parameter in found.items() if name not in ROS_OWN}


def merge(
    ctx: click.Context, options: Sequence[click.Parameter], parameters: Mapping[str, Parameter], known: Iterable[str]
) -> dict[str, Any]:
    """Values of the options that are given as parameters and not on the command line, by argument name."""
    # One file may be for several of our nodes, whose parameters are ``known``.
    own = {name_of(option): option for option in options}
    known = set(known) | own.keys()
    values: dict[str, Any] = {}
    for name, parameter in parameters.items():
        if name.startswith(f"{QOS_OVERRIDES}."):
            continue
        if name not in known:
            close = difflib.get_close_matches(name, sorted(known), 1)
            hint = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(sorted(own))}"
            raise InputError(f"parameter {name}: no node of msg_agents has this parameter: {hint}")
        option = own.get(name)
        if option is None or ctx.get_parameter_source(option.name or "") is ParameterSource.COMMANDLINE:
            continue
        wanted = _type_of(option)
        if parameter.type_ != wanted:
            hint = f"{parameter.value}.0" if wanted.name == "DOUBLE" and parameter.type_.name == "INTEGER" else ""
            raise InputError(
                f"parameter {name}: {parameter.value} is of type {parameter.type_.name.lower()}: expected "
                f"{wanted.name.lower()}{f', such as {hint}' if hint else ''}"
            )
        try:
            values[option.name or ""] = option.process_value(ctx, parameter.value)
        except click.BadParameter as error:
            raise InputError(f"parameter {name}: {error.message}") from error
    return values
