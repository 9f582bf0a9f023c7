"""Run the test files that depend on what has changed since they last passed: ``python
tools/changed.py``.

A test file depends on the modules of this repository that it names, on those that they name, on
data of src and tests, and on the versions of other packages. A test that names ROOT, and so reads
the repository itself, depends on every file.
"""

import ast
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path

FOLDERS = {"softfin": "src/softfin"} | {
    name: name for name in ("tests", "benchmarks", "results", "studies", "tools")
}
"""Folders of packages by their names."""

NAME = re.compile(rf"\b(?:{'|'.join(FOLDERS)})(?:\.\w+)*")
PYTEST = (sys.executable, "-m", "pytest")
RUNS = (
    ("-m", "not real_time", "-n", "auto", "--dist", "loadfile", "--no-loadscope-reorder"),
    ("-m", "real_time"),
)
"""As `make test` does."""


class Repository:
    """Its files, and what each of its test files depends on."""

    def __init__(self, root: Path) -> None:
        words = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
        listed = subprocess.run(words, cwd=root, capture_output=True, text=True, check=True).stdout
        names = sorted(set(filter(None, listed.split("\0"))))
        self.root = root
        self.files = [name for name in names if (root / name).is_file()]
        self._known = frozenset(self.files)
        self._text = cache(lambda name: (root / name).read_text())
        self._digest = cache(lambda name: hashlib.sha256((root / name).read_bytes()).hexdigest())
        self._named = cache(self._find_named)

    def digests(self) -> dict[str, str]:
        """What each test file depends on, as one number."""
        data = [
            name
            for name in self.files
            if name.startswith(("src/", "tests/")) and not name.endswith(".py")
        ]
        data += ["pyproject.toml", "uv.lock", "tests/conftest.py"]
        tests = [name for name in self.files if re.match(r"tests/(.*/)?test_\w+\.py$", name)]
        return {
            name: self._digest_of(
                self.files if "ROOT" in self._text(name) else {*data, *self.closure(name)}
            )
            for name in tests
        }

    def closure(self, name: str) -> set[str]:
        """A file and all that it names, in any number of steps; of a package that contains one of
        them, the ``__init__`` alone."""
        found = {name}
        open_files = [name]
        while open_files:
            more = self._named(open_files.pop()) - found
            found |= more
            open_files += more
        parents = {f"{parent}/__init__.py" for each in found for parent in Path(each).parents}
        return found | parents.intersection(self.files)

    def _digest_of(self, names: Iterable[str]) -> str:
        known = (f"{name} {self._digest(name)}" for name in sorted(names))
        return hashlib.sha256("\n".join(known).encode()).hexdigest()

    def _find_named(self, name: str) -> set[str]:
        """Modules in its imports and its strings; all of its package, where it imports by names
        that are computed."""
        text = self._text(name)
        modules = set(NAME.findall(text))
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.module:
                modules |= {f"{node.module}.{alias.name}" for alias in node.names}
        found = {file for module in modules if (file := self._file_of(module))}
        if "import_module" in text and not name.startswith("tests/"):
            package = f"{Path(name).parent}/"
            found |= {
                file for file in self.files if file.startswith(package) and file[-3:] == ".py"
            }
        return found

    def _file_of(self, module: str) -> str | None:
        """The innermost file of a dotted name, behind whose module there may be attributes."""
        top, *parts = module.split(".")
        while top in FOLDERS and parts:
            path = "/".join([FOLDERS[top], *parts])
            for file in (f"{path}.py", f"{path}/__init__.py"):
                if file in self._known:
                    return file
            parts.pop()
        return None


def main(root: Path) -> int:
    """Run what has changed; remember what passed."""
    memory = root / "build" / "passed.json"
    before = json.loads(memory.read_text()) if memory.exists() else {}
    now = Repository(root).digests()
    changed = [name for name in now if before.get(name) != now[name]]
    sys.stdout.write(f"{len(changed)} of {len(now)} test files depend on what has changed\n")
    sys.stdout.flush()
    if not changed:
        return 0
    codes = [
        subprocess.run([*PYTEST, *options, *changed], cwd=root, check=False).returncode
        for options in RUNS
    ]
    # 1: some failed; 5: there are none with that mark.
    if not set(codes) <= {0, 1, 5}:
        return max(codes)
    failures = root / ".pytest_cache" / "v" / "cache" / "lastfailed"
    failed = json.loads(failures.read_text()) if failures.exists() else {}
    passed = set(changed) - {test.partition("::")[0] for test in failed}
    memory.parent.mkdir(exist_ok=True)
    memory.write_text(json.dumps(before | {name: now[name] for name in passed}))
    return int(passed != set(changed))


if __name__ == "__main__":
    raise SystemExit(main(Path(__file__).parents[1]))
