"""The site of the documentation: what its pages are generated from, the layout for Foxglove, its
links.

`make docs` builds the site and runs the tutorials; here stands what can be tested without Sphinx.
"""

import json
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from softfin.cli import COMMANDS, import_function
from softfin.cli.application import list_options
from softfin.core import errors
from tests.data.recorded import record
from tests.documents import ROOT, links
from tests.test_documentation import CONFIGURATIONS

LAYOUT = json.loads((ROOT / "docs/foxglove-layout.json").read_text())


@pytest.fixture(scope="module")
def generate() -> SimpleNamespace:
    """The functions of docs/generate.py."""
    return SimpleNamespace(**runpy.run_path(str(ROOT / "docs/generate.py")))


def test_the_generated_pages_in_git_are_current():
    # In a process of its own: the tests' type check wraps what the pages describe.
    code = (
        "from docs.generate import pages\n"
        "print([file.name for file, text in pages().items() if file.read_text() != text])"
    )
    made = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert made.stdout == "[]\n", "python -m docs.generate writes them again"


def test_every_page_is_reached_by_links_from_the_readme():
    to_read = [ROOT / "README.md"]
    found = set(to_read)
    while to_read:
        page = to_read.pop()
        for link in links(page):
            target = (page.parent / link.partition("#")[0]).resolve()
            if target.suffix == ".md" and target not in found and target.is_file():
                found.add(target)
                to_read.append(target)
    pages = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("[!_]*/*.md")]
    assert {page for page in pages if page not in found} == set()
    assert {ROOT / "results/README.md", ROOT / "CONTRIBUTING.md"} <= found


def test_the_command_line_page_has_every_option_of_every_command(generate):
    text = "\n" + "\n".join(generate.command_line())
    for name in COMMANDS:
        section = text.split(f"\n## {name}\n")[1].split("\n## ")[0]
        assert all(option in section for option in list_options(import_function(name)))


def test_the_configuration_page_has_every_field_with_its_description(generate):
    text = "\n".join(generate.configuration())
    for command, configurations in CONFIGURATIONS.items():
        assert f"\n## softfin {command}\n" in f"\n{text}"
        for configuration in configurations:
            section = text.split(f"\n### {type(configuration).__name__}\n")[1].split("\n### ")[0]
            for field in type(configuration).model_fields:
                (row,) = (
                    line for line in section.splitlines() if line.startswith(f"| `{field}` |")
                )
                assert row.rstrip(" |").count(" | ") >= 2


def test_the_python_page_documents_what_is_public(generate):
    import softfin

    text = "\n".join(generate.python())
    assert [name for name in softfin.__all__ if f"softfin.{name}" not in text] == []


def test_the_errors_page_has_every_class(generate):
    text = "\n".join(generate.error_classes())
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    assert len(kinds) > 10
    assert all(f"| `{kind.__name__}`" in text for kind in kinds)
    assert (
        "or run softfin map or train again"
        in text.split("\n## ArtifactError\n")[1].split("\n## ")[0]
    )


def test_the_evidence_page_has_every_result(generate):
    text = "\n".join(generate.evidence())
    assert all(f"`results/{file.name}`" in text for file in (ROOT / "results").glob("*.json"))


def messages(path: Path) -> dict[str, Any]:
    """The last message of each topic, as a reader decodes it by the definitions in the bag."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return {channel.topic: decoded for _, channel, _, decoded in reader.iter_decoded_messages()}


def value_at(path: str, last: dict[str, Any]) -> Any:
    """A path of Foxglove's, as /topic.field.part[0]."""
    topic, *fields = path.replace("[", ".").replace("]", "").split(".")
    value = last[topic]
    for field in fields:
        value = value[int(field)] if field.isdigit() else getattr(value, field)
    return value


def panels(place: Any) -> list[str]:
    """The panels of a layout, which is a tree of splits."""
    return [place] if isinstance(place, str) else panels(place["first"]) + panels(place["second"])


def test_every_path_of_the_layout_leads_to_a_value_of_a_recording(tmp_path):
    last = messages(record(tmp_path / "run.mcap", 2))
    assert sorted(panels(LAYOUT["layout"])) == sorted(LAYOUT["configById"])
    paths = [
        path["value"] for panel in LAYOUT["configById"].values() for path in panel.get("paths", ())
    ]
    assert len(paths) >= 6
    for path in paths:
        assert isinstance(value_at(path, last), float), path
    logs = [panel["topicPath"] for panel in LAYOUT["configById"].values() if "topicPath" in panel]
    assert {path.split(".")[0] for path in logs} <= last.keys()


def test_a_dead_link_of_the_site_is_told(tmp_path):
    dead_links = runpy.run_path(str(ROOT / "docs/pages.py"))["dead_links"]
    (tmp_path / "more").mkdir()
    (tmp_path / "index.html").write_text(
        '<h1 id="top"></h1><a href="more/page.html#place"></a><a href="#top"></a><a href="https://example.org/x"></a>'
    )
    (tmp_path / "more/page.html").write_text('<p id="place"></p><a href="../index.html"></a>')
    assert dead_links(tmp_path) == []
    (tmp_path / "more/page.html").write_text(
        '<a href="../index.html#nothing"></a><img src="picture.png">'
    )
    assert dead_links(tmp_path) == [
        "index.html: more/page.html#place",
        "more/page.html: ../index.html#nothing",
        "more/page.html: picture.png",
    ]
