"""Tests the tests of the rig: changes one small thing in a copy of its code and sees whether a test
fails.

``make mutants`` draws mutants evenly over the modules in ``tools/mutants.toml`` and runs the tests
listed there for each module. The survivors then face the wider tests, many at a time. A survivor
needs a better test, or an explanation in that file; without one the exit code is 1.
``build/mutants`` keeps each outcome, so an interrupted run resumes until code or tests change.
"""

import argparse
import ast
import contextlib
import hashlib
import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]

COMPARISONS = {
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==",),
    "is": ("is not",),
    "is not": ("is",),
    "in": ("not in",),
    "not in": ("in",),
}
ARITHMETIC = {
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "//": "*",
    "**": "*",
    "<<": ">>",
    ">>": "<<",
    "&": "|",
    "|": "&",
}
FUNCTIONS = {
    "min": "max",
    "max": "min",
    "any": "all",
    "all": "any",
    "minimum": "maximum",
    "maximum": "minimum",
}
OPERATORS: dict[type[ast.AST], str] = {
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.Is: "is",
    ast.IsNot: "is not",
    ast.In: "in",
    ast.NotIn: "not in",
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.FloorDiv: "//",
    ast.Pow: "**",
    ast.LShift: "<<",
    ast.RShift: ">>",
    ast.BitAnd: "&",
    ast.BitOr: "|",
}
UNORDERED = {*FUNCTIONS, "isinstance", "getattr", "setattr", "hasattr"}
"""Functions whose arguments are not swapped: it would change nothing, or fail wherever it is
reached."""

SPARE_S = 60.0
"""Time that a mutant's tests have beyond three times that of the unchanged code [s]."""


class Mutation(NamedTuple):
    """A stretch of a module's source and its replacement."""

    module: str
    """Path within the package."""
    kind: str
    line: int
    start: int
    """Place of the stretch in the source [bytes]."""
    end: int
    replacement: str
    before: str
    """The lines of the stretch, without the space round them."""
    after: str
    """The same lines, mutated."""


class Project(NamedTuple):
    """The configuration of a run: ``tools/mutants.toml``."""

    root: Path
    package: str
    """Folder that the modules' paths are in."""
    wider: list[str]
    """Tests that survivors of their own tests face."""
    tests: dict[str, list[str]]
    """Tests that should notice a mutant of a module, the likeliest first."""
    explained: list[dict[str, str]]
    """Mutants that no test needs to notice: `module`, `source` line, its `replacement`,
    `reason`."""

    @classmethod
    def load(cls, root: Path) -> "Project":
        """Read the configuration of a checkout."""
        values = tomllib.loads((root / "tools" / "mutants.toml").read_text())
        return cls(
            root, values["package"], values["wider"], values["tests"], values.get("explained", [])
        )

    def reason(self, mutation: Mutation) -> str | None:
        """Return why no test needs to notice a mutation; matched by text, since line numbers
        change."""
        wanted = (mutation.module, mutation.before, mutation.after)
        for entry in self.explained:
            if (entry["module"], entry["source"], entry["replacement"]) == wanted:
                return entry["reason"]
        return None


class Outcome(NamedTuple):
    """The end of one run of tests."""

    status: str
    """survived, killed or timeout."""
    by: str
    """The first test that failed, or the time limit."""
    seconds: float


@cache
def find_mutations(module: str, source: str) -> tuple[Mutation, ...]:
    """Return all mutations of a module's source."""
    text = source.encode()
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def span(node: Any) -> tuple[int, int]:
        return starts[node.lineno - 1] + node.col_offset, starts[
            node.end_lineno - 1
        ] + node.end_col_offset

    found: dict[tuple[int, int, str], Mutation] = {}
    changes = (change for node in _code(ast.parse(source)) for change in _changes(node, text, span))
    for kind, start, end, replacement in changes:
        mutant = text[:start] + replacement.encode() + text[end:]
        with contextlib.suppress(SyntaxError):
            compile(mutant, module, "exec")
            first = text.rfind(b"\n", 0, start) + 1
            last = (text + b"\n").find(b"\n", end)
            number = text.count(b"\n", 0, start) + 1
            before = text[first:last].decode().strip()
            after = mutant[first : last + len(mutant) - len(text)].decode().strip()
            found[start, end, replacement] = Mutation(
                module, kind, number, start, end, replacement, before, after
            )
    return tuple(found.values())


Change = tuple[str, int, int, str]
"""Kind, start and end of the stretch [bytes], replacement."""

Span = Callable[[Any], tuple[int, int]]
"""Start and end of a node in the source [bytes]."""


def _changes(node: ast.AST, text: bytes, span: Span) -> Iterator[Change]:
    yield from _operator_changes(node, text, span)
    yield from _condition_changes(node, text, span)
    yield from _value_changes(node, text, span)
    yield from _statement_changes(node, span)
    if isinstance(node, ast.Call):
        yield from _call_changes(node, text, span)


def _operator_changes(node: ast.AST, text: bytes, span: Span) -> Iterator[Change]:
    match node:
        case ast.Compare(left=left, ops=operators, comparators=others):
            for one, operator, other in zip([left, *others], operators, others, strict=False):
                sign = OPERATORS[type(operator)]
                for new in COMPARISONS[sign]:
                    yield from _between("comparison", text, span(one)[1], span(other)[0], sign, new)
        case ast.BinOp(left=left, op=operator, right=right) if not _is_text(left) and not _is_text(
            right
        ):
            sign = OPERATORS.get(type(operator), "")
            if sign in ARITHMETIC:
                yield from _between(
                    "arithmetic", text, span(left)[1], span(right)[0], sign, ARITHMETIC[sign]
                )
        case ast.AugAssign(target=target, op=operator, value=value):
            sign = OPERATORS.get(type(operator), "")
            if sign in ARITHMETIC:
                new = ARITHMETIC[sign] + "="
                yield from _between(
                    "arithmetic", text, span(target)[1], span(value)[0], sign + "=", new
                )


def _condition_changes(node: ast.AST, text: bytes, span: Span) -> Iterator[Change]:
    match node:
        case ast.BoolOp(op=operator, values=values):
            sign, new = ("and", "or") if isinstance(operator, ast.And) else ("or", "and")
            yield from _between("boolean", text, span(values[0])[1], span(values[1])[0], sign, new)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            yield ("boolean", span(node)[0], span(operand)[0], "")
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            start, end = span(test)
            yield ("boolean", start, end, f"(not ({text[start:end].decode()}))")


def _value_changes(node: ast.AST, text: bytes, span: Span) -> Iterator[Change]:
    match node:
        case ast.UnaryOp(op=ast.USub()):
            yield ("constant", span(node)[0], span(node)[0] + 1, "")
        case ast.Constant(value=bool(value)):
            yield ("constant", *span(node), str(not value))
        case ast.Constant(value=int(value) | float(value)):
            start, end = span(node)
            number = text[start:end].decode()
            yield ("constant", start, end, f"({number} + 1)")
            if value:
                yield ("constant", start, end, f"({number} * 2)")
                yield ("constant", start, end, f"(-{number})")
        case ast.Slice(lower=lower, upper=upper):
            for bound in (lower, upper):
                if bound is not None:
                    start, end = span(bound)
                    number = text[start:end].decode()
                    yield ("slice", start, end, f"{number} + 1")
                    yield ("slice", start, end, f"{number} - 1")


def _statement_changes(node: ast.AST, span: Span) -> Iterator[Change]:
    match node:
        case (
            ast.Raise()
            | ast.Return()
            | ast.Break()
            | ast.Continue()
            | ast.Expr(value=ast.Call())
            | ast.Assign(targets=[ast.Attribute(), *_])
            | ast.AugAssign(target=ast.Attribute())
        ):
            yield ("statement", *span(node), "pass")


def _call_changes(node: ast.Call, text: bytes, span: Span) -> Iterator[Change]:
    name = ast.unparse(node.func).rpartition(".")[2]
    if name in FUNCTIONS:
        end = span(node.func)[1]
        yield ("function", end - len(name), end, FUNCTIONS[name])
    if len(node.args) < 2 or name in UNORDERED:
        return
    first, second = node.args[:2]
    if isinstance(first, ast.Starred) or isinstance(second, ast.Starred):
        return
    start, first_end = span(first)
    second_start, end = span(second)
    one = text[start:first_end]
    between = text[first_end:second_start]
    other = text[second_start:end]
    if one != other:
        yield ("arguments", start, end, (other + between + one).decode())


def _between(kind: str, text: bytes, start: int, end: int, sign: str, new: str) -> Iterator[Change]:
    """Yield the replacement of an operator between its operands, round which there may be
    brackets."""
    pattern = r"\s+".join(map(re.escape, sign.split()))
    place = re.search(pattern.encode(), text[start:end])
    if place is not None:
        yield (kind, start + place.start(), start + place.end(), new)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and not isinstance(node.value, int | float)
    )


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """Walk through code that runs: neither annotations nor texts, in which no test should look for
    numbers."""
    yield node
    for name, field in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list") or isinstance(node, ast.JoinedStr):
            continue
        for child in field if isinstance(field, list) else [field]:
            if isinstance(child, ast.AST):
                yield from _code(child)


def draw(project: Project, modules: Sequence[str], number: int, seed: int) -> list[Mutation]:
    """Draw mutations evenly over modules, and within a module evenly over kinds, so that constants
    do not prevail."""
    drawn = []
    for index, module in enumerate(modules):
        source = (project.root / project.package / module).read_text()
        kinds = defaultdict(list)
        for mutation in find_mutations(module, source):
            kinds[mutation.kind].append(mutation)
        # A generator per module: the draw of one does not depend on the changes of another.
        generator = random.Random(f"{seed} {module}")
        share = number // len(modules) + (index < number % len(modules))
        for _ in range(share):
            if not kinds:
                break
            kind = generator.choice(sorted(kinds))
            drawn.append(kinds[kind].pop(generator.randrange(len(kinds[kind]))))
            if not kinds[kind]:
                del kinds[kind]
    return drawn


class Workshop:
    """Copies of the checkout in a temporary folder, one per worker; the checkout itself is never
    touched."""

    def __init__(self, project: Project, folder: Path, workers: int) -> None:
        self._project = project
        self._modified_s = itertools.count(round(time.time()) + 1)
        self._idle: Queue[Path] = Queue()
        files = _files_of(project.root)
        for number in range(workers):
            copy = folder / f"copy-{number}"
            for file in files:
                (copy / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(project.root / file, copy / file)
            self._idle.put(copy)

    def run(self, mutations: Sequence[Mutation], tests: Sequence[str], limit_s: float) -> Outcome:
        """Run tests on a copy with mutations in it, which must not overlap."""
        copy = self._idle.get()
        try:
            with self._mutated(copy, mutations):
                return _run_tests(copy, tests, limit_s)
        finally:
            self._idle.put(copy)

    @contextlib.contextmanager
    def _mutated(self, copy: Path, mutations: Sequence[Mutation]) -> Iterator[None]:
        originals: dict[Path, tuple[bytes, float]] = {}
        for mutation in sorted(mutations, key=lambda mutation: mutation.start, reverse=True):
            file = copy / self._project.package / mutation.module
            content = file.read_bytes()
            originals.setdefault(file, (content, file.stat().st_mtime))
            file.write_bytes(
                content[: mutation.start] + mutation.replacement.encode() + content[mutation.end :]
            )
        # Python takes bytecode for current if size and second of its source agree, so no two
        # mutants share a second.
        for file in originals:
            modified_s = next(self._modified_s)
            os.utime(file, (modified_s, modified_s))
        try:
            yield
        finally:
            for file, (content, modified) in originals.items():
                file.write_bytes(content)
                os.utime(file, (modified, modified))


def _files_of(root: Path) -> list[str]:
    """The files of a checkout that git would keep; without git, all of them."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True)
    if listed.returncode == 0:
        names = listed.stdout.splitlines()
    else:
        names = [str(file.relative_to(root)) for file in root.rglob("*")]
    return sorted(name for name in names if (root / name).is_file())


def _run_tests(copy: Path, tests: Sequence[str], limit_s: float) -> Outcome:
    """Run tests in a copy until the first one fails."""
    started = time.monotonic()
    # Mutants draw the same examples as the unchanged code, so that an outcome is not a matter of
    # chance.
    plugins = ["-p", "no:cacheprovider", "-p", "_hypothesis_pytestplugin", "--hypothesis-seed=0"]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-o", "addopts=-rfE", *plugins]
    paths = os.pathsep.join([str(copy / "src"), str(copy)])
    # The other plugins take longer to load than most tests take to run.
    environment = os.environ | {"PYTHONPATH": paths, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(
            [*command, *tests],
            cwd=copy,
            env=environment,
            stdout=output,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            return Outcome("timeout", f"{limit_s:.0f} s", time.monotonic() - started)
        finally:
            # Tests start processes of their own, which a mutant may leave behind.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        output.seek(0)
        lines = output.read().splitlines()
    seconds = time.monotonic() - started
    if code == 0:
        return Outcome("survived", "", seconds)
    if code in (4, 5):
        raise SystemExit(f"{' '.join(tests)}: pytest cannot run them:\n" + "\n".join(lines[-20:]))
    failed = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]
    return Outcome("killed", failed[0][:200] if failed else f"pytest ended with {code}", seconds)


class Journal:
    """Outcomes of one state of the checkout, a JSON line each."""

    def __init__(self, project: Project) -> None:
        digest = hashlib.sha256()
        for name in _files_of(project.root):
            if name.startswith(("src/", "tests/")) and name.endswith(".py"):
                digest.update(name.encode() + (project.root / name).read_bytes())
        folder = project.root / "build" / "mutants"
        folder.mkdir(parents=True, exist_ok=True)
        self._file = folder / f"{digest.hexdigest()[:16]}.jsonl"
        self._outcomes: dict[str, Outcome] = {}
        if self._file.exists():
            for line in self._file.read_text().splitlines():
                entry = json.loads(line)
                self._outcomes[entry["run"]] = Outcome(
                    entry["status"], entry["by"], entry["seconds"]
                )

    def outcome(self, name: str, run: Callable[[], Outcome]) -> Outcome:
        """Return the outcome of a run, which is done unless it was done before."""
        if name not in self._outcomes:
            outcome = run()
            self._outcomes[name] = outcome
            with self._file.open("a") as file:
                file.write(json.dumps({"run": name, **outcome._asdict()}) + "\n")
            sys.stderr.write(f"{outcome.status:8} {outcome.seconds:6.1f} s  {name}\n")
        return self._outcomes[name]


class Run:
    """A run over drawn mutants."""

    def __init__(self, project: Project, workshop: Workshop, pool: ThreadPoolExecutor) -> None:
        self._project = project
        self._workshop = workshop
        self._pool = pool
        self._journal = Journal(project)

    def baseline(self, tests: Sequence[str]) -> float:
        """Return the time that tests take on unchanged code, which must pass them [s]."""
        outcome = self._journal.outcome(
            f"baseline {' '.join(tests)}", lambda: self._workshop.run([], tests, limit_s=3600)
        )
        if outcome.status != "survived":
            raise SystemExit(
                f"{' '.join(tests)}: failed without a mutant ({outcome.by}); repair them first"
            )
        return outcome.seconds

    def outcomes(self, mutations: Sequence[Mutation]) -> dict[Mutation, Outcome]:
        """Run the tests of each mutant's module, then the wider tests on all survivors."""
        modules = sorted({mutation.module for mutation in mutations})
        baselines = self._pool.map(
            lambda module: self.baseline(self._project.tests[module]), modules
        )
        limits = {
            module: 3 * seconds + SPARE_S
            for module, seconds in zip(modules, baselines, strict=True)
        }

        def run_own(mutation: Mutation) -> Outcome:
            tests = self._project.tests[mutation.module]
            limit_s = limits[mutation.module]
            return self._journal.outcome(
                plant_name(mutation), lambda: self._workshop.run([mutation], tests, limit_s)
            )

        outcomes = dict(zip(mutations, self._pool.map(run_own, mutations), strict=True))
        survivors = [
            mutation
            for mutation, outcome in outcomes.items()
            if outcome.status == "survived" and self._project.reason(mutation) is None
        ]
        if survivors and self._project.wider:
            limit_s = 3 * self.baseline(self._project.wider) + SPARE_S
            for found in self._pool.map(
                lambda group: self._run_wider(group, limit_s), apart(survivors)
            ):
                outcomes.update(found)
        return outcomes

    def _run_wider(self, group: list[Mutation], limit_s: float) -> dict[Mutation, Outcome]:
        """Run the wider tests on many mutants at once, and on either half if they fail: most
        survivors survive."""
        name = "wider " + " + ".join(map(plant_name, group))
        outcome = self._journal.outcome(
            name, lambda: self._workshop.run(group, self._project.wider, limit_s)
        )
        if outcome.status == "survived":
            return dict.fromkeys(group, outcome)
        if len(group) == 1:
            return {group[0]: outcome._replace(by=f"wider: {outcome.by}")}
        half = len(group) // 2
        return self._run_wider(group[:half], limit_s) | self._run_wider(group[half:], limit_s)


def apart(mutations: Sequence[Mutation]) -> list[list[Mutation]]:
    """Return groups, two or more where possible, in which no two mutations touch the same lines."""
    groups: list[list[Mutation]] = [[], []]
    for mutation in mutations:
        for group in sorted(groups, key=len):
            if not any(_touch(mutation, other) for other in group):
                group.append(mutation)
                break
        else:
            groups.append([mutation])
    return [group for group in groups if group]


def _touch(one: Mutation, other: Mutation) -> bool:
    return one.module == other.module and one.start <= other.end and other.start <= one.end


def plant_name(mutation: Mutation) -> str:
    """Return the name by which a mutant is known in the journal and in the table."""
    before, after = (" ".join(text.split()) for text in (mutation.before, mutation.after))
    return (
        f"{mutation.module}:{mutation.line} {mutation.kind} `{before}` -> `{after}` "
        f"@{mutation.start}"
    )


def report(project: Project, outcomes: dict[Mutation, Outcome]) -> bool:
    """Print the table; return whether each survivor is explained."""
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0, 0])
    unexplained = []
    for mutation, outcome in outcomes.items():
        reason = project.reason(mutation)
        if outcome.status == "timeout":
            sys.stdout.write(f"timeout after {outcome.by}: {plant_name(mutation)}\n")
        if outcome.status != "survived":
            column = 1 if outcome.status == "timeout" else 0
        elif reason is not None:
            column = 2
            sys.stdout.write(f"explained: {plant_name(mutation)}: {reason}\n")
        else:
            column = 3
            unexplained.append(mutation)
        counts[mutation.module][column] += 1
    header = ("killed", "timeout", "explained", "survived")
    sys.stdout.write(f"\n{'module':28}" + "".join(f"{name:>11}" for name in header) + "\n")
    total = [sum(column) for column in zip(*counts.values(), strict=True)]
    for module, row in [*sorted(counts.items()), ("all", total)]:
        sys.stdout.write(f"{module:28}" + "".join(f"{count:11}" for count in row) + "\n")
    for mutation in unexplained:
        sys.stdout.write(f"survived: {plant_name(mutation)}\n")
    return not unexplained


def stale_explanations(project: Project) -> list[str]:
    """Return the explanations of mutants that can no longer be drawn, since the source has
    changed."""
    stale = []
    for entry in project.explained:
        file = project.root / project.package / entry["module"]
        mutations = find_mutations(entry["module"], file.read_text()) if file.exists() else ()
        if not any(
            (m.before, m.after) == (entry["source"], entry["replacement"]) for m in mutations
        ):
            stale.append(f"{entry['module']}: `{entry['source']}` -> `{entry['replacement']}`")
    return stale


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Run the mutants; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "number", nargs="?", type=int, default=200, help="mutants to draw (default: 200)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")
    parser.add_argument(
        "--workers", type=int, default=2, help="mutants that run at a time (default: 2)"
    )
    parser.add_argument(
        "--modules", nargs="+", metavar="MODULE", help="modules to mutate (default: all)"
    )
    options = parser.parse_args(arguments)
    project = Project.load(root)
    modules = options.modules or list(project.tests)
    if unknown := sorted(set(modules) - set(project.tests)):
        parser.error(f"{', '.join(unknown)}: not in tools/mutants.toml; add them with their tests")
    stale = stale_explanations(project)
    for explanation in stale:
        sys.stdout.write(
            f"tools/mutants.toml: {explanation}: no such mutant; remove the explanation\n"
        )
    mutations = draw(project, modules, options.number, options.seed)
    # The pool ends before its folder goes: the tests of an interrupted run must not fail for want
    # of their files.
    with (
        tempfile.TemporaryDirectory(prefix="softfin-mutants-") as folder,
        ThreadPoolExecutor(options.workers) as pool,
    ):
        workshop = Workshop(project, Path(folder), options.workers)
        outcomes = Run(project, workshop, pool).outcomes(mutations)
    is_explained = report(project, outcomes)
    return 0 if is_explained and not stale else 1


if __name__ == "__main__":
    sys.exit(main())
