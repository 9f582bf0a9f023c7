"""Tests the tests: changes one small thing in a copy of the code and sees whether a test fails.

``make mutants`` draws mutants from all packages. The tests of a module are the file that mirrors
its path and the test files nearest to it in the graph of imports; ``tools/mutants.toml`` names the
exceptions, and the mutants that no test needs to notice. A survivor needs a better test or an
explanation there; without one the exit code is 1. The outcomes are written to
``build/mutants.json``, from which ``REPEAT`` draws the same mutants again.

Each mutant is tested in a fork of this process, which has imported the libraries but nothing of
softfin.
"""

import argparse
import ast
import contextlib
import importlib
import itertools
import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).parents[1]

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
FUNCTIONS = {
    "min": "max",
    "max": "min",
    "any": "all",
    "all": "any",
    "minimum": "maximum",
    "maximum": "minimum",
}
STATEMENTS = (ast.Raise, ast.Return, ast.Break, ast.Continue)
UNORDERED = {
    *FUNCTIONS,
    "isinstance",
    "getattr",
    "setattr",
    "hasattr",
    "allclose",
    "isclose",
    "hypot",
}
"""Functions whose arguments are not swapped: it would change nothing, or fail wherever it is
reached."""

FEW = 8
"""Test files that import a module, above which only those of its folder count."""


class Mutation(NamedTuple):
    """A change of one place in a module."""

    module: str
    """Path within the package."""
    function: str
    """Qualified name of the function or class that has the place; empty for the module."""
    kind: str
    line: int
    before: str
    """The statement, or the head of a compound one."""
    after: str
    """The same, mutated."""

    @property
    def place(self) -> tuple[str, str, str, str]:
        """All but the line, which other changes move."""
        return self.module, self.function, self.before, self.after

    def __str__(self) -> str:
        return f"{self.module}:{self.line} {self.kind} `{self.before}` -> `{self.after}`"


def find_mutations(module: str, source: str) -> list[Mutation]:
    """Return all mutations of a module's source."""
    return [mutation for mutation, _ in _mutants(module, ast.parse(source))]


def mutate(source: str, wanted: Mutation) -> str:
    """Return a module's source with a mutation in it."""
    tree = ast.parse(source)
    mutants = _mutants(wanted.module, tree)
    return next(ast.unparse(tree) for mutation, _ in mutants if mutation == wanted)


class Place(NamedTuple):
    """Where a node hangs in the tree."""

    parent: ast.AST
    field: str
    index: int | None
    statement: ast.stmt
    function: str

    @property
    def node(self) -> Any:
        """What hangs there."""
        value = getattr(self.parent, self.field)
        return value if self.index is None else value[self.index]

    def put(self, node: ast.AST) -> None:
        """Hang another node there."""
        if self.index is None:
            setattr(self.parent, self.field, node)
        else:
            getattr(self.parent, self.field)[self.index] = node


def _mutants(module: str, tree: ast.Module) -> Iterator[tuple[Mutation, ast.Module]]:
    """Yield each mutation, while it is in the tree."""
    for place in list(_places(tree, "")):
        node = place.node
        before = _head(place.statement)
        known = {before}
        changes = list(_changes(node, place))
        for kind, new in changes:
            place.put(ast.fix_missing_locations(ast.copy_location(new, node)))
            changed = place.node if node is place.statement else place.statement
            after = _head(changed)
            if after not in known:
                known.add(after)
                line = place.statement.lineno
                yield Mutation(module, place.function, kind, line, before, after), tree
            place.put(node)


def _places(parent: ast.AST, function: str, statement: ast.stmt | None = None) -> Iterator[Place]:
    """Walk through code that runs: neither annotations nor texts, in which no test should look for
    numbers."""
    for field, value in ast.iter_fields(parent):
        if field in ("annotation", "returns", "decorator_list"):
            continue
        for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            own = child if isinstance(child, ast.stmt) else statement
            inner = function
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                inner = f"{function}.{child.name}".lstrip(".")
            if own is not None:
                yield Place(parent, field, index, own, inner)
            yield from _places(child, inner, own)


def _head(statement: ast.stmt) -> str:
    """A statement in one line, without its body."""
    fields = dict(ast.iter_fields(statement))
    bodies = {"body", "orelse", "handlers", "finalbody", "cases", "decorator_list"}
    for name in bodies & fields.keys():
        fields[name] = []
    return " ".join(ast.unparse(type(statement)(**fields, lineno=0)).split())


def _changes(node: ast.AST, place: Place) -> Iterator[tuple[str, ast.AST]]:
    """Yield kinds and replacements of a node."""
    if isinstance(node, ast.Constant):
        yield from _constant_changes(node)
    elif isinstance(node, ast.Call):
        yield from _call_changes(node, node.func, node.args)
    elif isinstance(node, STATEMENTS) or _is_attribute_set(node):
        yield "statement", ast.Pass()
    else:
        yield from _operator_changes(node)
    if isinstance(place.parent, ast.Slice) and not isinstance(node, ast.Constant):
        yield "slice", ast.BinOp(node, ast.Add(), ast.Constant(1))
        yield "slice", ast.BinOp(node, ast.Sub(), ast.Constant(1))
    is_condition = isinstance(place.parent, ast.If | ast.While | ast.IfExp)
    if is_condition and place.field == "test" and not isinstance(node, ast.Compare | ast.UnaryOp):
        yield "boolean", ast.UnaryOp(ast.Not(), node)


def _is_attribute_set(node: ast.AST) -> bool:
    match node:
        case ast.Expr(value=ast.Call()) | ast.Assign(targets=[ast.Attribute(), *_]):
            return True
    return False


def _constant_changes(node: ast.Constant) -> Iterator[tuple[str, ast.AST]]:
    match node.value:
        case bool(value):
            yield "constant", ast.Constant(not value)
        case int(value) | float(value):
            yield "constant", ast.Constant(value + 1)
            if value:
                yield "constant", ast.Constant(value * 2)
                yield "constant", ast.UnaryOp(ast.USub(), node)


def _operator_changes(node: Any) -> Iterator[tuple[str, ast.AST]]:
    match node:
        case ast.Compare(left=left, ops=operators, comparators=others):
            for index, operator in enumerate(operators):
                for new in COMPARISONS[type(operator)]:
                    changed = [*operators[:index], new(), *operators[index + 1 :]]
                    yield "comparison", ast.Compare(left, changed, others)
        case ast.BinOp(left=left, op=operator, right=right):
            if type(operator) in ARITHMETIC and not (_is_text(left) or _is_text(right)):
                yield "arithmetic", ast.BinOp(left, ARITHMETIC[type(operator)](), right)
        case ast.AugAssign(target=target, op=operator, value=value):
            if type(operator) in ARITHMETIC:
                yield "arithmetic", ast.AugAssign(target, ARITHMETIC[type(operator)](), value)
        case ast.BoolOp(op=operator, values=values):
            other = ast.Or() if isinstance(operator, ast.And) else ast.And()
            yield "boolean", ast.BoolOp(other, values)
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield "boolean" if isinstance(node.op, ast.Not) else "constant", operand


def _call_changes(
    call: ast.Call, function: ast.expr, arguments: list[ast.expr]
) -> Iterator[tuple[str, ast.AST]]:
    name = ast.unparse(function).rpartition(".")[2]
    if name in FUNCTIONS:
        new: ast.expr = ast.Name(FUNCTIONS[name])
        if isinstance(function, ast.Attribute):
            new = ast.Attribute(function.value, FUNCTIONS[name])
        yield "function", ast.Call(new, arguments, call.keywords)
    starred = any(isinstance(argument, ast.Starred) for argument in arguments[:2])
    if len(arguments) >= 2 and name not in UNORDERED and not starred:
        swapped = [arguments[1], arguments[0], *arguments[2:]]
        yield "arguments", ast.Call(function, swapped, call.keywords)


def _is_text(node: ast.AST) -> bool:
    is_number = isinstance(node, ast.Constant) and isinstance(node.value, int | float)
    return isinstance(node, ast.Constant | ast.JoinedStr) and not is_number


class Project:
    """A checkout and its ``tools/mutants.toml``."""

    def __init__(self, root: Path) -> None:
        self.root = root
        settings = tomllib.loads((root / "tools" / "mutants.toml").read_text())
        self.package = root / settings["package"]
        self._left_out = [root / name for name in settings["left_out"]]
        self.last: list[str] = settings["last"]
        """Tests that should notice a mutant of any module."""
        self._exceptions: dict[str, list[str]] = settings["tests"]
        self._explained: list[dict[str, str]] = settings.get("explained", [])
        self._importers = self._find_importers()

    def modules(self, chosen: Sequence[str]) -> list[str]:
        """Return the modules that are, or are in a folder that is, among the chosen; of none,
        all."""
        files = sorted(self.package.rglob("*.py"))
        modules = [str(file.relative_to(self.package)) for file in files]
        if not chosen:
            return modules
        return [name for name in modules if any(Path(name).is_relative_to(one) for one in chosen)]

    def mutations(self, module: str) -> list[Mutation]:
        """Return all mutations of a module."""
        return find_mutations(module, (self.package / module).read_text())

    def tests(self, module: str) -> list[str]:
        """Return the test files that should notice a mutant of a module, the likeliest first."""
        if module in self._exceptions:
            return self._exceptions[module]
        mirrored = self.root / "tests" / Path(module).with_name(f"test_{Path(module).name}")
        nearest = self._nearest_tests(self.package / module, mirrored.parent)
        files = [mirrored] * mirrored.exists() + [file for file in nearest if file != mirrored]
        return [str(file.relative_to(self.root)) for file in files]

    def reason(self, mutation: Mutation) -> str:
        """Return why no test needs to notice a mutation; empty if one needs to."""
        for entry in self._explained:
            if (entry["module"], entry["before"], entry["after"]) == (
                mutation.module,
                mutation.before,
                mutation.after,
            ):
                return entry["reason"]
        return ""

    def stale_explanations(self) -> list[str]:
        """Return the explanations of mutants that no longer exist."""
        stale = []
        for entry in self._explained:
            module, before, after = entry["module"], entry["before"], entry["after"]
            found = self.mutations(module) if (self.package / module).exists() else []
            if not any((each.before, each.after) == (before, after) for each in found):
                stale.append(f"{module}: `{before}` -> `{after}`")
        return stale

    def _nearest_tests(self, file: Path, folder: Path) -> list[Path]:
        """The test files at the fewest imports from a file: those in the folder first, and if
        they are many, those alone."""
        seen = {file}
        level = [file]
        while level:
            level = sorted({each for near in level for each in self._importers[near]} - seen)
            seen.update(level)
            tests = [each for each in level if each.name.startswith("test_")]
            if tests:
                own = [test for test in tests if test.is_relative_to(folder)]
                others = [test for test in tests if test not in own]
                return own if own and len(tests) > FEW else own + others
        return []

    def _find_importers(self) -> dict[Path, set[Path]]:
        """The files that import each file."""
        files = {}
        for top in (self.package, self.root / "tests"):
            for file in sorted(top.rglob("*.py")):
                if not any(file.is_relative_to(left) for left in self._left_out):
                    parts = file.relative_to(top.parent).with_suffix("").parts
                    files[".".join(parts).removesuffix(".__init__")] = file
        importers: dict[Path, set[Path]] = defaultdict(set)
        for file in files.values():
            for name in _imported(ast.parse(file.read_text())) & files.keys():
                importers[files[name]].add(file)
        return importers


def _imported(tree: ast.Module) -> set[str]:
    names = set()
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=aliases):
                names.update(alias.name for alias in aliases)
            case ast.ImportFrom(module=str(module), names=aliases):
                names.update([module, *(f"{module}.{alias.name}" for alias in aliases)])
    return names


def draw(project: Project, modules: Sequence[str], number: int, seed: int) -> list[Mutation]:
    """Draw mutations evenly over packages, then modules, then kinds, so that constants do not
    prevail."""
    packages = defaultdict(list)
    for module in modules:
        packages[_package(module)].append(_shuffled(project.mutations(module), seed, module))
    for name, rows in packages.items():
        random.Random(f"{seed} {name}").shuffle(rows)
    rows = _alternate([_alternate(each) for each in packages.values()])
    return list(itertools.islice(rows, number))


def _package(module: str) -> str:
    return Path(module).parent.parts[0] if "/" in module else "softfin"


def _shuffled(mutations: list[Mutation], seed: int, module: str) -> Iterator[Mutation]:
    # A generator per module: the draw of one does not depend on the changes of another.
    generator = random.Random(f"{seed} {module}")
    kinds = defaultdict(list)
    for mutation in mutations:
        kinds[mutation.kind].append(mutation)
    rows = [generator.sample(kinds[kind], len(kinds[kind])) for kind in sorted(kinds)]
    generator.shuffle(rows)
    return _alternate(rows)


def _alternate(rows: Sequence[Any]) -> Iterator[Any]:
    """One of each row, then the next of each, until all are used up."""
    iterators = [iter(row) for row in rows]
    while iterators:
        left = []
        for iterator in iterators:
            for item in itertools.islice(iterator, 1):
                yield item
                left.append(iterator)
        iterators = left


class Outcome(NamedTuple):
    """The end of one run of tests."""

    status: str
    """survived, killed, timeout or untested."""
    by: str
    """The test that failed, or did not end."""
    seconds: float


class Server:
    """Runs tests in forks of this process, on a copy of the checkout."""

    def __init__(self, project: Project, copy: Path, silence_s: float) -> None:
        self._project = project
        self._copy = copy
        self._silence_s = silence_s
        self._modified_s = itertools.count(round(time.time()) + 1)
        self._sound: set[str] = set()
        command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
        listed = subprocess.run(command, cwd=project.root, capture_output=True, text=True)
        for name in listed.stdout.splitlines():
            if (project.root / name).is_file():
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(project.root / name, copy / name)
        sys.path[:0] = [str(copy / "src"), str(copy)]
        os.environ["PYTHONPATH"] = f"{copy / 'src'}{os.pathsep}{copy}"
        # The other plugins take longer to load than most tests take to run.
        os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"

    def test(self, mutation: Mutation) -> Outcome:
        """Run a mutant's tests until one fails, and that one without the mutant, which it must
        pass."""
        tests = self._project.tests(mutation.module)
        if not tests:
            return Outcome("untested", "", 0.0)
        tests = [*tests, *self._project.last]
        module = self._project.package / mutation.module
        source = module.read_text()
        self._write(module, mutate(source, mutation))
        outcome = self._run(tests)
        self._write(module, source)
        if outcome.by and outcome.by not in self._sound:
            alone = self._run([outcome.by])
            if alone.status != "survived":
                output = (self._copy / OUTPUT).read_text()
                raise SystemExit(f"{outcome.by}: fails without a mutant; repair it\n{output}")
            self._sound.add(outcome.by)
        return outcome

    def _write(self, module: Path, source: str) -> None:
        file = self._copy / module.relative_to(self._project.root)
        file.write_text(source)
        # Python takes bytecode for current if size and second of its source agree, so no two
        # mutants share a second.
        modified_s = next(self._modified_s)
        os.utime(file, (modified_s, modified_s))

    def _run(self, tests: Sequence[str]) -> Outcome:
        started = time.monotonic()
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            _run_pytest(self._copy, tests, writing)
        os.close(writing)
        told = b""
        while not told.endswith(END):
            is_silent = not select.select([reading], [], [], self._silence_s)[0]
            new = b"" if is_silent else os.read(reading, 65536)
            if not new:
                break
            told += new
        os.close(reading)
        # Tests start processes of their own, which a mutant may leave behind.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        seconds = time.monotonic() - started
        last = {"test": tests[0], "failed": ""}
        last.update(line.split(" ", 1) for line in told.decode().splitlines()[:-1])
        if "libraries" in last:
            self._import_libraries(json.loads(last["libraries"]))
        if is_silent:
            return Outcome("timeout", last["test"], seconds)
        if last.get("code") == "0":
            return Outcome("survived", "", seconds)
        return Outcome("killed", last["failed"] or last["test"], seconds)

    def _import_libraries(self, used: dict[str, Any]) -> None:
        """Import what a fork has imported, for the next ones."""
        os.environ.update(used["environment"])
        for name in used["modules"]:
            with contextlib.suppress(Exception):
                importlib.import_module(name)


OUTPUT = "output of pytest"
"""File in the copy."""

END = b"end\n"
"""The last that a fork tells."""


def _run_pytest(copy: Path, tests: Sequence[str], writing: int) -> None:
    """Run tests in this process, which then ends."""
    os.setsid()
    nowhere = os.open(os.devnull, os.O_RDONLY)
    output = os.open(copy / OUTPUT, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream, file in enumerate((nowhere, output, output)):
        os.dup2(file, stream)
    os.chdir(copy)
    # Mutants draw the same examples as the unchanged code, so that an outcome is not a matter of
    # chance.
    plugins = ["-p", "no:cacheprovider", "-p", "_hypothesis_pytestplugin", "--hypothesis-seed=0"]
    options = ["-x", "-q", "-o", "addopts=", *plugins]
    code = pytest.main([*options, *tests], plugins=[Teller(copy, writing)])
    os.write(writing, f"code {int(code)}\n".encode() + END)
    os._exit(0)


class Teller:
    """A plugin of pytest that tells the server how its tests go."""

    def __init__(self, copy: Path, writing: int) -> None:
        self._copy = copy
        self._writing = writing

    def _tell(self, word: str, text: str) -> None:
        os.write(self._writing, f"{word} {text}\n".encode())

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Tell which test runs."""
        self._tell("test", nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Tell of a test that fails."""
        if report.failed:
            self._tell("failed", report.nodeid)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Tell of a file that cannot be imported."""
        if report.failed:
            self._tell("failed", report.nodeid)

    def pytest_sessionfinish(self) -> None:
        """Tell which libraries were imported, and with which settings."""
        modules = [
            name
            for name, module in list(sys.modules.items())
            # Pytest rewrites its plugins when it imports them.
            if "pytest" not in name
            and not str(getattr(module, "__file__", "")).startswith(str(self._copy))
        ]
        environment = {
            name: value for name, value in os.environ.items() if name.startswith(("JAX_", "XLA_"))
        }
        self._tell("libraries", json.dumps({"modules": modules, "environment": environment}))


def report(project: Project, outcomes: dict[Mutation, Outcome]) -> bool:
    """Print the table; return whether each survivor is explained."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    listed = []
    for mutation, outcome in outcomes.items():
        status = outcome.status
        if status in ("survived", "untested"):
            reason = project.reason(mutation)
            status = "explained" if reason else status
            listed.append(f"{status}: {mutation}{': ' if reason else ''}{reason}")
        counts[_package(mutation.module)][status] += 1
        counts["all"][status] += 1
    columns = ("killed", "timeout", "explained", "survived", "untested")
    sys.stdout.write(f"{'package':16}" + "".join(f"{name:>11}" for name in columns) + "\n")
    for package in sorted(counts, key=lambda name: (name == "all", name)):
        row = "".join(f"{counts[package][name]:11}" for name in columns)
        sys.stdout.write(f"{package:16}{row}\n")
    sys.stdout.write("\n".join([*sorted(listed), ""]))
    return not counts["all"]["survived"] + counts["all"]["untested"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the mutants; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("number", nargs="?", type=int, default=200, help="mutants (default: 200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")
    parser.add_argument("--modules", nargs="+", default=[], help="modules or folders to draw from")
    parser.add_argument("--repeat", type=Path, help="outcomes whose mutants run again")
    parser.add_argument("--silence", type=float, default=120, help="longest time of a test [s]")
    parser.add_argument(
        "--out", type=Path, help="file of the outcomes (default: build/mutants.json)"
    )
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout")
    options = parser.parse_args(arguments)
    project = Project(options.root)
    modules = project.modules(options.modules)
    if not modules:
        parser.error(f"--modules {' '.join(options.modules)}: no such module in {project.package}")
    stale = project.stale_explanations()
    for explanation in stale:
        sys.stdout.write(f"tools/mutants.toml: {explanation}: no such mutant; remove it\n")
    if options.repeat:
        mutations = find_again(project, modules, json.loads(options.repeat.read_text()))
    else:
        mutations = draw(project, modules, options.number, options.seed)
    out = options.out or options.root / "build" / "mutants.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    outcomes = {}
    with tempfile.TemporaryDirectory(prefix="softfin-mutants-") as folder:
        server = Server(project, Path(folder), options.silence)
        for mutation in mutations:
            outcome = server.test(mutation)
            outcomes[mutation] = outcome
            sys.stderr.write(f"{outcome.status:8} {outcome.seconds:6.1f} s  {mutation}\n")
            rows = [each._asdict() | end._asdict() for each, end in outcomes.items()]
            out.write_text(json.dumps(rows, indent=1) + "\n")
    return 0 if report(project, outcomes) and not stale else 1


def find_again(
    project: Project, modules: Sequence[str], rows: list[dict[str, Any]]
) -> list[Mutation]:
    """Find the mutants of earlier outcomes in the present code."""
    found = []
    for module in sorted({row["module"] for row in rows} & set(modules)):
        known = {mutation.place: mutation for mutation in project.mutations(module)}
        for row in rows:
            place = tuple(row[name] for name in ("module", "function", "before", "after"))
            if place in known:
                found.append(known[place])
    sys.stdout.write(f"{len(found)} of {len(rows)} mutants still exist\n")
    return found


if __name__ == "__main__":
    sys.exit(main())
