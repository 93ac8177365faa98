"""Start a network as ROS 2 nodes, record it, and compare the record with the theory.

    ros2 launch msg_agents_bringup network.launch.py experiment:=line_ring duration:=50.0

All decisions are made in msg_agents.running.launch_support; this file only passes them to launch.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit, OnShutdown
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage

from msg_agents.running.launch_support import NETWORK_ARGUMENTS, LaunchedNetwork, environment


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in NETWORK_ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])


def start(context):
    """The nodes, and the actions when they end. An exception in any of them ends the launch with exit code 1."""
    arguments = {name: LaunchConfiguration(name).perform(context) for name in NETWORK_ARGUMENTS}
    network = LaunchedNetwork(arguments, Path(get_package_share_directory("msg_agents_bringup")))
    actions = [RegisterEventHandler(OnShutdown(on_shutdown=lambda *_: network.close()))]
    for process in network.processes:
        node = Node(
            package="msg_agents",
            executable=process.arguments[0],
            arguments=list(process.arguments[1:]),
            namespace=network.namespace or None,
            exec_name=process.name,
            additional_env=environment(),
            output="screen",
        )
        actions += [
            node,
            RegisterEventHandler(OnProcessExit(target_action=node, on_exit=ending(network, process.name))),
        ]
    return actions


def ending(network, name):
    """The action when the process of this name has ended."""

    def on_exit(event, context):
        return after(network) if network.ended(name, event.returncode) else None

    return on_exit


def after(network):
    """The actions after a complete run."""
    done = EmitEvent(event=Shutdown(reason="the run is complete"))
    if network.analysis is None:
        return [done]

    def on_exit(event, context):
        network.analysed(event.returncode)
        return [done]

    analysis = ExecuteProcess(
        cmd=[ExecutableInPackage(executable="msg-analysis", package="msg_analysis"), *network.analysis],
        output="screen",
    )
    return [
        LogInfo(msg=f"the run is complete: {network.bag}"),
        RegisterEventHandler(OnProcessExit(target_action=analysis, on_exit=on_exit)),
        analysis,
    ]
