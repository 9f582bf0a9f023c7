"""Checks the words of softfin: names, docstrings, messages and documents use the field's terms;
part of ``make lint``.

Exits with 1 and one line for each word that is not to be used, with the one to use instead.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "softfin"

NAMES = {
    "fresh": "is_first",
    "seen_after": "next_privileged_observation",
    "log_density": "log_prob",
    "log_deviation": "log_std",
    "gradient_norm": "max_grad_norm",
    "value_weight": "value_coef",
    "rollout_actions": "num_steps",
    "minibatches": "num_minibatches",
    "Lesson": "Batch",
    "Lane": "AgentState",
    "having_seen": "update_statistics",
    "scorings": "num_evaluations",
    "judge": "evaluate",
    "judged": "evaluate",
    "Shown": "Demonstrations",
    "CommonConfig": "SharedPretraining",
    "common_start": "pretrain_shared_policy",
    "beat": "gait",
    "Made": "GaitResponse",
    "made": "simulate_gait",
    "steady": "steady_state_force",
    "Found": "GaitSearchResult",
    "missed": "force_error",
    "known": "force_map",
    "Known": "ForceMap",
    "pulled": "project",
    "least_box": "bounding_box",
    "grown": "expanded",
    "admitted": "resolve_reference",
    "held_n": "tracked_reference_n",
    "in_charge": "active_cell",
    "taken_over": "warm_up_memory",
    "Said": "ForcePrediction, LiveReference",
    "said": "a noun",
    "foretold": "predicted_motion",
    "heard": "predicted_motion",
    "Freed": "FreeRunPrediction",
    "freed": "prediction",
    "beyond_data": "out_of_distribution_fraction",
    "doubt": "stop_unconfirmed, uncertainty",
    "Place": "Segment",
    "Piece": "Segment",
    "Stretch": "Segment",
    "Subject": "EvaluationTarget",
    "Spread": "DomainRandomization",
    "drawn": "sample_tank",
    "randomised": "sample_tank",
    "Conditions": "DomainRandomization",
    "under": "with_parameters",
    "Facts": "LogStatistics",
    "facts": "metadata",
    "Finding": "Issue",
    "also": "extra_files",
    "Workspace": "RunDirectory",
    "workspace": "run_directory",
    "Bench": "RobotSetup",
    "TrimState": "FeedbackState",
    "TrimConfig": "FeedbackConfig",
    "TrimmedController": "Feedback",
}
"""Names of classes, functions, arguments, variables and attributes -> the name to use."""

LOCAL_NAMES = {
    "learning": {
        "cut": "truncated",
        "raw": "pre_tanh_action",
        "seen": "observation",
        "deviation": "init_std",
        "trace": "gae_lambda",
        "clip": "clip_ratio",
        "entropy": "entropy_coef",
        "environments": "num_envs",
        "epochs": "num_epochs",
        "score": "evaluate",
        "show": "record_demonstrations",
    },
    "gaits": {"wave": "waveform"},
    "control": {"share": "blend", "said": "action"},
    "surrogate": {"floor": "noise_floor"},
}
"""The same for names that mean something else in other rooms."""

PHRASES = {
    r"(?<!there )\bis no (?!longer|more)\w+": "is not a ...",
    r"\bleft alone\b": "free-running",
    r"\blogs? to learn from\b": "training logs",
    r"\blogs? to score on\b": "test logs",
    r"--accept\b": "--ignore-errors",
    r"--spread\b": "--randomize",
    r"--then\b": "--next-reference",
    r"\bbefore the squashing\b": "pre-tanh",
    r"\bwhat (it|he|she) lived through\b": "the transitions",
    r"\bin charge\b": "active",
    r"\bthe nets? (say|says|said|know|knows)\b": "predict",
    r"\bthe fin (knows|is told|was told)\b": "is commanded",
}
"""Phrases of docstrings, messages, help and documents -> what to write."""

OPENINGS = re.compile(
    r"^(Of|From|Likewise|The same|As the(re)?|As here|What|Those|Its|Their|They|It|In "
    r"words|Which|Why|Where)\b"
)
"""Beginnings of docstrings that cannot be understood alone."""


def main() -> int:
    """Print what is to be written another way; the exit code."""
    found = [line for file in sorted(PACKAGE.rglob("*.py")) for line in check_code(file)]
    for file in [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/[!_]*.md"))]:
        found += check_text(file, 1, file.read_text())
    sys.stdout.write("".join(f"{line}\n" for line in dict.fromkeys(found)))
    sys.stdout.write(f"{len(dict.fromkeys(found))} words to change\n")
    return 1 if found else 0


def check_code(file: Path) -> Iterator[str]:
    """The lines of one module's findings: names, docstrings, messages."""
    names = NAMES | LOCAL_NAMES.get(file.relative_to(PACKAGE).parts[0], {})
    tree = ast.parse(file.read_text())
    modules = {name for node in ast.walk(tree) for name in modules_of(node)}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id in modules
        ):
            # A name of another library, such as jnp.clip.
            continue
        for name in names_of(node):
            if name.strip("_") in names:
                yield f"{file.relative_to(ROOT)}:{node.lineno}: {name} -> {names[name.strip('_')]}"  # type: ignore[attr-defined]
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from check_text(file, node.lineno, node.value)
        match node:
            case ast.Expr(ast.Constant(str(text))) if opening := OPENINGS.match(text):
                yield (
                    f"{file.relative_to(ROOT)}:{node.lineno}: docstring begins with "
                    f"{opening[0]!r} -> name the thing"
                )


def check_text(file: Path, line: int, text: str) -> Iterator[str]:
    """The lines of the phrases in a text."""
    for phrase, better in PHRASES.items():
        for match in re.finditer(phrase, text):
            at = line + text.count("\n", 0, match.start())
            yield f"{file.relative_to(ROOT)}:{at}: {match[0]!r} -> {better}"


def modules_of(node: ast.AST) -> Iterator[str]:
    """The names by which a piece of code imports whole modules."""
    if isinstance(node, ast.Import):
        yield from (alias.asname or alias.name.partition(".")[0] for alias in node.names)


def names_of(node: ast.AST) -> Iterator[str]:
    """The names that a piece of code defines or uses."""
    match node:
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
            yield name
        case ast.arg(arg=str(name)) | ast.keyword(arg=str(name)):
            yield name
        case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name):
            yield name


if __name__ == "__main__":
    sys.exit(main())
