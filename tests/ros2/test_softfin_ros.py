"""The package in ros2/: not run under ROS 2, which is not to be had here."""

import ast
import pkgutil
import runpy
import sys
import types
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

from softfin.cli import COMMANDS, application
from softfin.core.quantities import PAPER_LIMITS
from softfin.rig.ros2.config import fin_topics
from softfin.robot.description import load_robot
from softfin.robot.node_config import RobotNodeConfig
from softfin.tank.fin import FinConfig
from softfin_ros.fin_parameters import FinParameters
from tests.ros2 import stand_ins

PACKAGE = Path(__file__).parents[2] / "ros2" / "softfin_ros"
LAUNCH_FILES = sorted((PACKAGE / "launch").glob("*.launch.py"))
CONFIGS = sorted((PACKAGE / "config").glob("*.yaml"))


@pytest.fixture(scope="module")
def package():
    catkin = pytest.importorskip("catkin_pkg.package")
    warnings = []
    found = catkin.parse_package(str(PACKAGE / "package.xml"), warnings=warnings)
    found.validate(warnings=warnings)
    assert warnings == []
    return found


@pytest.fixture(scope="module")
def setup():
    """What setup.py tells setuptools."""
    told = {}
    with pytest.MonkeyPatch.context() as patches:
        patches.chdir(PACKAGE)
        stand_ins.module(patches, "setuptools", setup=told.update)
        runpy.run_path("setup.py")
    return told


@pytest.fixture
def launch(monkeypatch):
    stand_ins.install_launch(monkeypatch)

    def load(path):
        return runpy.run_path(str(path))

    return load


@pytest.fixture
def nodes(monkeypatch):
    """The modules of the package."""
    stand_ins.install_rclpy(monkeypatch)
    with stand_ins.imported_nodes() as modules:
        yield modules


def actions(value):
    """All actions within an action, with those that a handler or a function returns."""
    if isinstance(value, stand_ins.Action):
        yield value
        for inner in (*value.values, *value.named.values()):
            yield from actions(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from actions(inner)


def described(load, path):
    """All actions of a launch file."""
    loaded = load(path)
    found = list(actions(loaded["generate_launch_description"]()))
    for action in list(found):
        if type(action).__name__ == "OpaqueFunction":
            context = defaults(found)
            found += actions(action.named["function"](context))
    return found


def defaults(found):
    return {
        action.values[0]: action.named["default_value"]
        for action in found
        if type(action).__name__ == "DeclareLaunchArgument"
    }


def executables(setup):
    return {
        line.partition(" ")[0]: line.split()[-1]
        for line in setup["entry_points"]["console_scripts"]
    }


def test_the_package_is_valid_and_agrees_with_its_setup(package, setup):
    assert package.get_build_type() == "ament_python"
    for name in ("name", "version", "description"):
        assert setup[name] == getattr(package, name)
    assert [setup["license"]] == package.licenses
    files = dict(setup["data_files"])
    assert files["share/ament_index/resource_index/packages"] == ["resource/softfin_ros"]
    assert files["share/softfin_ros"] == ["package.xml"]
    for group in files.values():
        assert group
        assert all((PACKAGE / name).is_file() for name in group)
    installed = {PACKAGE / name for group in files.values() for name in group}
    assert {*LAUNCH_FILES, *CONFIGS, *(PACKAGE / "urdf").iterdir()} <= installed


def test_what_the_package_imports_and_launches_is_among_its_dependencies(package):
    needed = {"robot_state_publisher", "xacro"}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                needed.add(node.module.partition(".")[0])
            elif isinstance(node, ast.Import):
                needed |= {alias.name.partition(".")[0] for alias in node.names}
    needed -= {
        *sys.stdlib_module_names,
        "setuptools",
        "softfin",
        "softfin_ros",
        "numpy",
        "pydantic",
    }
    dependencies = {each.name for each in package.exec_depends}
    assert needed <= dependencies


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_files_name_executables_files_and_arguments_that_are_there(path, launch, setup):
    found = described(launch, path)
    own = [a for a in found if a.named.get("package") == "softfin_ros"]
    assert {action.named["executable"] for action in own} <= executables(setup).keys()
    arguments = defaults(found)
    for action in found:
        if type(action).__name__ == "LaunchConfiguration":
            assert action.values[0] in arguments
        if type(action).__name__ == "PathJoinSubstitution":
            assert PACKAGE.joinpath(*action.values[0][1:]).is_file()


def test_a_robot_has_one_node_per_fin_with_frames_under_its_name(launch):
    found = described(launch, PACKAGE / "launch" / "robot.launch.py")
    fins = [action for action in found if type(action).__name__ == "LifecycleNode"]
    names = [action.named["namespace"] for action in fins]
    assert sorted(names) == sorted(load_robot("ucat").fins)
    assert all(
        a.named["parameters"][1]["frame"] == f"{a.named['namespace']}/fin_mount" for a in fins
    )
    publishers = [a for a in found if a.named.get("package") == "robot_state_publisher"]
    assert [a.named["parameters"][0]["frame_prefix"] for a in publishers] == [
        f"{n}/" for n in names
    ]


def test_the_commands_of_the_emulated_fin_are_commands_of_softfin(launch):
    found = described(launch, PACKAGE / "launch" / "emulated_fin.launch.py")
    processes = {
        action.named["cmd"][2]: action.named["cmd"]
        for action in found
        if type(action).__name__ == "ExecuteProcess"
    }
    # Those after the first are behind the handlers.
    for handler in found:
        started = handler.named.get("on_stdout", lambda event: [])
        for action in started(types.SimpleNamespace(text=b"this rig runs until Ctrl-C")):
            processes[action.named["cmd"][2]] = action.named["cmd"]
        on_exit = handler.named.get("on_exit", lambda event, context: [])
        assert on_exit(types.SimpleNamespace(returncode=1), None) == []
        for action in on_exit(types.SimpleNamespace(returncode=0), None):
            if "cmd" in action.named:
                processes[action.named["cmd"][2]] = action.named["cmd"]
    assert sorted(processes) == ["check", "emulate", "zero"]
    for command in processes.values():
        function = pkgutil.resolve_name(COMMANDS[" ".join(command[1:3])].place)
        assert application.parse(function, command[3:])


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_parameters_of_the_files_are_parameters_of_the_nodes(path, nodes):
    for node, values in yaml.safe_load(path.read_text()).items():
        given = values["ros__parameters"]
        if node.endswith("softfin_robot"):
            assert given.keys() <= {*nodes.robot.FIELDS, "robot", "max_thrust"}
            RobotNodeConfig.build(given)
        else:
            built = FinParameters.build(given)
            built.node_config(fin_topics("tail"))


@pytest.mark.parametrize("arguments", [{}, {"parent": "base_link", "joint": "tail"}])
def test_the_description_of_the_fin_is_a_tree_of_frames(arguments):
    xacro = pytest.importorskip("xacro")
    path = str(PACKAGE / "urdf" / "fin.urdf.xacro")
    text = xacro.process_file(path, mappings=arguments).toxml()
    robot = ElementTree.fromstring(text)
    links = {link.get("name") for link in robot.iter("link")}
    root = arguments.get("parent")
    assert links == {"fin_mount", "fin_blade"} | ({root} if root else set())
    children = [joint.find("child").get("link") for joint in robot.iter("joint")]
    assert len(children) == len(links) - 1
    joint = next(joint for joint in robot.iter("joint") if joint.get("type") == "revolute")
    assert joint.get("name") == arguments.get("joint", "fin")
    assert joint.find("axis").get("xyz") == "0 0 -1"
    length, thickness, span = map(float, robot.find(".//box").get("size").split())
    fin = FinConfig()
    assert (length, thickness, span) == (fin.length_m, fin.root_thickness_m, fin.span_m)
    limit = joint.find("limit")
    assert float(limit.get("upper")) == pytest.approx(PAPER_LIMITS.angle_max, abs=1e-4)
    assert float(limit.get("lower")) == pytest.approx(PAPER_LIMITS.angle_min, abs=1e-4)
    assert float(limit.get("velocity")) == pytest.approx(PAPER_LIMITS.velocity_max, abs=1e-4)
