"""What README and docs show can be typed as it stands: commands, options, configurations, names,
links."""

import contextlib
import inspect
import json
import pkgutil
import re
import runpy
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache, partial
from itertools import chain, combinations, product
from pathlib import Path

import pytest
import yaml
from PIL import Image
from results.__main__ import make_parser
from results.parts import PARTS

import softfin
from softfin.cli import COMMANDS, application, import_function, main
from softfin.core.configuration import Configuration, configure
from softfin.core.errors import ConfigurationError
from softfin.data.collect import CollectConfig
from softfin.evaluation.benchmark import BenchmarkProtocol
from softfin.evaluation.evaluate import EvaluateConfig
from softfin.evaluation.find_family import FamilyConfig
from softfin.gaits.force_map import MapConfig
from softfin.learning.configuration import TRAIN_PRESETS
from softfin.rig.config import load_rig, load_ros2
from softfin.rig.ros2.config import NodeConfig
from softfin.robot.evaluate import RobotEvaluateConfig
from softfin.robot.node_config import RobotNodeConfig
from softfin.stages.driving import RunConfig
from softfin.storage.dataset import Dataset
from softfin.surrogate import FitConfig, StreamingConfig
from softfin.tank.calibration.config import CALIBRATE_PRESETS as CALIBRATIONS
from tests.documents import (
    CELL,
    MARKDOWN,
    ROOT,
    Block,
    blocks,
    command_name,
    commands,
    headings,
    links,
    plant_name,
    softfin_words,
    spans,
)

CONFIGURATIONS: dict[str, tuple[Configuration, ...]] = {
    "collect": (CollectConfig(),),
    "fit": (StreamingConfig(), FitConfig()),
    "calibrate": tuple(CALIBRATIONS.values()),
    "map": (MapConfig(),),
    "train": tuple(TRAIN_PRESETS.values()),
    "family": (FamilyConfig(),),
    "run": (RunConfig(),),
    "robot evaluate": (RobotEvaluateConfig(),),
    "robot ros2": (RobotNodeConfig(),),
    "evaluate": (EvaluateConfig(),),
    "benchmark": (BenchmarkProtocol(),),
    "ros2": (NodeConfig(),),
}
"""Of each command that has one, what --config and fields as options may change."""

WHOLE = tuple(shown for shown in commands() if not shown.in_sentence)
IN_SENTENCES = tuple(shown for shown in commands() if shown.in_sentence)


class Parsed(Exception):
    """In place of the work: the words were understood."""


def understood(words: tuple[str, ...]) -> partial | None:
    """What the command line makes of these words, its configuration included; it ends where it
    refuses them."""
    name = command_name(words)
    if name not in COMMANDS:
        main([*words, "--debug"])
        return None
    flags = ("--json", "--debug")
    rest = [word for word in words[len(name.split()) :] if word not in flags]
    call = application.parse(import_function(name), rest)
    parameters = inspect.signature(call.func).parameters
    bases = CONFIGURATIONS.get(name, ())
    assert bool(bases) == ("config" in parameters), (
        f"{name}: CONFIGURATIONS does not say what it configures"
    )
    if bases and "config" in call.keywords:
        configured(call.keywords["config"], bases)
    return call


def configured(changes: object, bases: tuple[Configuration, ...]) -> None:
    """One of them takes all that was asked for; else what the first has against it is raised."""
    refusals = []
    for base in bases:
        try:
            configure(base, changes)
        except ConfigurationError as error:
            refusals.append(error)
        else:
            return
    raise refusals[0]


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


def test_the_documents_show_commands_of_every_kind():
    names = {command_name(words) for shown in WHOLE if (words := softfin_words(shown))}
    assert names == set(COMMANDS), "a command that no document shows, or one that is none"
    assert {shown.words[0] for shown in WHOLE} == {"softfin", "python", "make", "pip"}


@pytest.mark.parametrize("shown", [shown for shown in WHOLE if softfin_words(shown)], ids=str)
def test_a_command_of_a_block_is_understood_as_it_stands(shown, monkeypatch, tmp_path):
    if shown.in_cell:
        # Beside it lie the files that other cells of its page write.
        for block in blocks():
            if block.document == shown.document and block.text.startswith("%%writefile "):
                name, _, text = block.text.removeprefix("%%writefile ").partition("\n")
                (tmp_path / name).write_text(text)
        monkeypatch.chdir(tmp_path)
    understood(softfin_words(shown))


@pytest.mark.parametrize(
    "shown", [shown for shown in IN_SENTENCES if softfin_words(shown)], ids=str
)
def test_a_command_in_a_sentence_is_understood_when_what_it_leaves_out_is_added(shown):
    completed(softfin_words(shown))


def test_a_command_without_its_program_is_understood_too():
    """As `evaluate --feedback`."""
    found = [
        text
        for _, _, text in spans()
        if command_name(tuple(text.split())) in COMMANDS and " --" in text
    ]
    assert found
    for text in found:
        completed(tuple(text.split()))


def completed(words):
    name = command_name(words)
    rest = words[len(name.split()) :]
    assert name in COMMANDS
    refusals = []
    for value in ((), ("1",)):
        for places, missing in product(((), ("x",), ("x", "x")), subsets(required(name))):
            try:
                understood((*name.split(), *places, *rest, *value, *missing))
            except (SystemExit, ConfigurationError, pytest.fail.Exception) as error:
                refusals.append(error)
            else:
                return
    raise AssertionError(f"{' '.join(words)}: refused whatever is added to it: {refusals[0]}")


def required(name: str) -> list[str]:
    """Options without a default."""
    arguments = application.make_app(import_function(name)).assemble_argument_collection()
    return [each.name for each in arguments if each.required and each.name.startswith("--")]


def subsets(names: list[str]) -> list[tuple[str, ...]]:
    """Each with a value for every name."""
    some = chain.from_iterable(combinations(names, count) for count in range(len(names) + 1))
    return [
        tuple(word for name in names for word in (name, VALUES.get(name, "x"))) for names in some
    ]


VALUES = {"--reference": "1,0", "--onnx": "x.onnx"}
"""Of options that do not take any text."""


@cache
def options() -> set[str]:
    """Of all commands and scripts, and the fields of configurations."""
    names = {"--help", "--version", "--json", "--debug", "--extra"}
    # Nested in a field that is null by default; and an option that has a new name.
    names |= {"--feedback.drift-n", "--feedback.uses", "--trim"}
    for command in COMMANDS:
        names.update(application.list_options(import_function(command)))
    for base in chain(*CONFIGURATIONS.values()):
        names.update(dotted(base.model_dump()))
    scripts = "".join(
        path.read_text()
        for folder in ("docs", "examples", "studies")
        for path in (ROOT / folder).rglob("*.py")
    )
    names |= set(re.findall(r'add_argument\(\s*"(--[\w-]+)"', scripts))
    return names


def dotted(values: dict[str, object], path: str = "--") -> Iterator[str]:
    """The options of nested fields."""
    for name, value in values.items():
        option = f"{path}{name.replace('_', '-')}"
        yield option
        if isinstance(value, dict):
            yield from dotted(value, f"{option}.")


def test_an_option_in_a_sentence_is_one_that_there_is():
    named = {text.split()[0].partition("=")[0] for _, _, text in spans() if text.startswith("--")}
    assert len(named) > 20
    assert named <= options(), named - options()


@pytest.mark.parametrize(
    "shown", [shown for shown in commands() if shown.words[0] == "make"], ids=str
)
def test_a_target_of_make_and_its_variables_are_there(shown):
    makefile = (ROOT / "Makefile").read_text()
    target, *variables = shown.words[1:]
    assert re.search(rf"^{target}:", makefile, re.MULTILINE)
    for variable in variables:
        assert f"$({variable.partition('=')[0]})" in makefile


@pytest.mark.parametrize(
    "shown", [shown for shown in commands() if shown.words[0] == "pip"], ids=str
)
def test_what_pip_installs_is_softfin_from_here(shown):
    """Nothing is published, so that the name alone would install nothing, or somebody else's
    package."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    words = shown.words[2:]
    # The versions that were tested, which `make wheel` writes.
    for word in words[2:] if words[:2] == ("-c", "dist/constraints.txt") else words:
        name, _, extras = word.rstrip("]").partition("[")
        assert name in (".", f"dist/softfin-{project['version']}-py3-none-any.whl")
        assert set(filter(None, extras.split(","))) <= set(project["optional-dependencies"])


@pytest.mark.parametrize(
    "shown",
    {shown.words: shown for shown in commands() if shown.words[0] == "python"}.values(),
    ids=str,
)
def test_a_script_is_there_and_understands_its_options(shown, monkeypatch, tmp_path):
    program, *words = shown.words[1:]
    if program == "-m" and words[0] == "results":
        arguments = make_parser().parse_args(words[1:])
        assert {name.partition("/")[0] for name in arguments.parts} <= set(PARTS)
        return
    if program == "-m" and words[0] == "benchmarks":
        package, *names = words
        assert all((ROOT / package / f"{name}.py").is_file() for name in ("__main__", *names))
        return
    if program == "-m":
        program = f"{words.pop(0).replace('.', '/')}.py"
    script = ROOT / program
    # A script without options does its work at once, so what it reads is there.
    monkeypatch.chdir(tmp_path)
    for word in words:
        if word.endswith(".png"):
            (tmp_path / word).parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (8, 6)).save(tmp_path / word)
    if not reaches_work(script, words, monkeypatch):
        with Image.open(tmp_path / words[-1]) as written:
            assert written.width > 8


def reaches_work(script, words, monkeypatch):
    """Whether a script understands its words and then begins its work, instead of finishing it."""
    stop_at_work(monkeypatch)
    # As Python does for a script, so that it finds modules next to it.
    monkeypatch.syspath_prepend(str(script.parent))
    monkeypatch.setattr(sys, "argv", [str(script), *words])
    with contextlib.suppress(Parsed):
        runpy.run_path(str(script), run_name="__main__")
        return False
    return True


def stop_at_work(monkeypatch):
    """Where a script that has understood its words begins: with a recording, a dataset, a plant, a
    controller, a file, or a program."""

    def work(*words, **options):
        raise Parsed

    # First of all, because softfin keeps a name once it was used.
    for name in ("collect", "map_forces", "find_plant", "load_controller"):
        monkeypatch.setattr(softfin, name, work)
    monkeypatch.setattr("softfin.stages.collect.collect", work)
    monkeypatch.setattr("softfin.stages.controllers.map_forces", work)
    monkeypatch.setattr("softfin.storage.registry.find_plant", work)
    monkeypatch.setattr("softfin.control.store.load_controller", work)
    monkeypatch.setattr("softfin.tank.Tank.init", work)
    monkeypatch.setattr(Path, "read_bytes", work)
    monkeypatch.setattr(Dataset, "open", work)
    monkeypatch.setattr(subprocess, "Popen", work)


def python_blocks() -> list[Block]:
    shown = [block for block in blocks() if block.kind != CELL]
    return [block for block in shown if block.kind == "python" or block.text.startswith("import ")]


@pytest.mark.parametrize(
    "block", python_blocks(), ids=lambda block: f"{block.document}:{block.line}"
)
def test_python_calls_what_there_is_with_arguments_that_it_takes(block, monkeypatch):
    called = []
    for name in softfin.__all__:
        value = getattr(softfin, name)
        if inspect.isfunction(value):
            monkeypatch.setattr(softfin, name, recorded(name, inspect.signature(value), called))
    exec(compile(block.text, block.document, "exec"), {"Path": Path})
    assert called


def recorded(name, signature, called):
    return lambda *words, **options: called.append((name, signature.bind(*words, **options)))


def test_the_python_of_the_package_is_among_what_was_tried():
    assert any(block.document == "src/softfin/__init__.py" for block in python_blocks())


def test_yaml_is_a_rig_or_a_fin_of_topics_that_softfin_takes(tmp_path):
    """A block that says "as above" stands upon the one before it."""
    file = tmp_path / "shown.yaml"
    before = {}
    found = []
    for block in blocks():
        if block.kind == "yaml":
            values = yaml.safe_load(block.text)
            if "as above" in block.text:
                # Topics and limits are added to those above; another device replaces the one above.
                for name in ("topics", "safety"):
                    if name in before:
                        values[name] = before[name] | values.get(name, {})
                values = {**before, **values}
            file.write_text(yaml.safe_dump(values))
            found.append((load_rig if "drive" in values else load_ros2)(file))
            before = values
    assert len(found) == 5


def test_json_is_json():
    for block in blocks():
        if block.kind == "json":
            json.loads(block.text)


def test_fences_are_of_a_kind_that_is_looked_at():
    of_the_site = {"include", "toctree", CELL}
    assert {block.kind for block in blocks()} <= {"", "yaml", "python", "json"} | of_the_site


@pytest.mark.parametrize("path", MARKDOWN, ids=plant_name)
def test_links_and_pictures_lead_somewhere(path):
    for target in links(path):
        if "://" not in target:
            place, _, anchor = target.partition("#")
            found = (path.parent / place).resolve() if place else path
            assert found.exists(), target
            assert not anchor or anchor in headings(found), target


def test_files_and_names_of_the_code_are_there():
    python = {
        path.relative_to(ROOT / top).as_posix()
        for top in ("", "src/softfin")
        for path in code(ROOT / top)
    }
    for document, line, text in spans():
        if re.fullmatch(r"[\w/]+/\w+\.py", text):
            assert text in python, f"{document}:{line} {text}"
        if re.fullmatch(r"softfin(\.\w+)+", text):
            pkgutil.resolve_name(text)


def code(folder: Path) -> Iterator[Path]:
    tops = (
        ("src", "tests", "docs", "examples", "benchmarks", "results", "studies")
        if folder == ROOT
        else (".",)
    )
    return (path for top in tops for path in (folder / top).rglob("*.py"))


def test_the_moving_picture_of_the_readme_is_small_and_lasts_six_seconds():
    path = ROOT / "docs" / "fin.webp"
    assert path.stat().st_size < 600_000
    with Image.open(path) as picture:
        num_frames = picture.n_frames
        durations_ms = []
        for index in range(num_frames):
            picture.seek(index)
            picture.load()
            durations_ms.append(picture.info["duration"])
    assert sum(durations_ms) == 6_000
    assert (ROOT / "README.md").read_text().splitlines()[2].startswith('<img src="docs/fin.webp"')
