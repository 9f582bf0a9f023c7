"""Prints the counts by which the structure of softfin is judged: ``make structure``."""

import ast
import sys
from collections import Counter, defaultdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import words

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "softfin"
SURROGATES = {"Surrogate", "StreamingSurrogate"}


def main() -> None:
    """Print rooms with their lines, then the counts."""
    trees = {
        file.relative_to(PACKAGE): ast.parse(file.read_text())
        for file in sorted(PACKAGE.rglob("*.py"))
    }
    lines = {file: len((PACKAGE / file).read_text().splitlines()) for file in trees}
    rooms: Counter[str] = Counter()
    for file, count in lines.items():
        rooms[file.parts[0] if len(file.parts) > 1 else "(top)"] += count
    for room, count in rooms.most_common():
        modules = [
            file for file in lines if (file.parts[0] if len(file.parts) > 1 else "(top)") == room
        ]
        sys.stdout.write(f"{room:12} {count:6,} lines in {len(modules):3} files\n")
    classes = defaultdict(list)
    steps = defaultdict(list)
    tests = []
    for file, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                classes[node.name].append(str(file))
                methods = {inner.name for inner in node.body if isinstance(inner, ast.FunctionDef)}
                if "act" in methods and "Protocol" not in map(ast.unparse, node.bases):
                    steps[node.name].append(str(file))
            if (
                isinstance(node, ast.Call)
                and ast.unparse(node.func) == "isinstance"
                and file.parts[0] != "surrogate"
            ):
                named = {name.id for name in ast.walk(node.args[1]) if isinstance(name, ast.Name)}
                tests += [f"{file}:{node.lineno}"] if SURROGATES & named else []
    shared = {
        name: files for name, files in classes.items() if len(files) > 1 and name != "Arguments"
    }
    found = [line for file in sorted(PACKAGE.rglob("*.py")) for line in words.check_code(file)]
    long = [f"{file} ({count})" for file, count in lines.items() if count > 300]
    short = [file for file, count in lines.items() if count < 40 and file.name != "__init__.py"]
    top = [str(file) for file in lines if len(file.parts) == 1]
    report = [
        ("lines in src (Python)", f"{sum(lines.values()):,}", ""),
        ("modules at the top of softfin/", len(top), ", ".join(top)),
        (
            "classes with a controller's step",
            len(steps),
            ", ".join(f"{name} ({files[0]})" for name, files in steps.items()),
        ),
        ("isinstance on a concrete surrogate elsewhere", len(tests), ", ".join(tests)),
        ("class names that stand for two things", len(shared), ", ".join(sorted(shared))),
        ("words of terms to change", len(set(found)), ""),
        ("files over 300 lines", len(long), ", ".join(long)),
        ("files under 40 lines", len(short), ""),
    ]
    for what, count, which in report:
        sys.stdout.write(f"{what:46} {count!s:>7}  {which}\n")


if __name__ == "__main__":
    main()
