"""What git knows about a figure: the commit at which it was measured, its age and what has changed
since.

A commit that this clone does not have (in a shallow clone, say) has no known age; that is reported,
not raised.
"""

import subprocess
import time
from collections.abc import Sequence

from results import ROOT

STEP_INPUTS = (
    "src",
    "uv.lock",
    "benchmarks",
    "examples",
    "results/scripts.py",
    "studies",
    "docs/calibration.yaml",
)
"""Files that decide what a step computes, besides its command."""

FIGURE_INPUTS = (*STEP_INPUTS, "results/parts")
"""Files that can change a figure: those of its steps and the definition of the figure."""

UNKNOWN_AGE = "age unknown"


def run_git(*words: str) -> str | None:
    """Return what git prints; None without git, outside a repository or for an unknown commit."""
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def read_head() -> str | None:
    """Return the abbreviated commit of the working tree."""
    return run_git("rev-parse", "--short=7", "HEAD")


def has_changes() -> bool:
    """Return whether inputs of a step have changes that no commit contains."""
    return bool(run_git("status", "--porcelain", "--", *STEP_INPUTS))


def has_commit(commit: str) -> bool:
    """Return whether this clone has a commit."""
    return run_git("cat-file", "-e", f"{commit}^{{commit}}") is not None


def has_full_history() -> bool:
    """Return whether this is a git clone with all commits."""
    return run_git("rev-parse", "--is-shallow-repository") == "false"


def list_commits_since(commit: str) -> set[str]:
    """Return the commits, abbreviated, from one on to HEAD: itself and its descendants."""
    first = run_git("rev-parse", "--short=7", f"{commit}^{{commit}}")
    later = run_git(
        "rev-list", "--abbrev-commit", "--abbrev=7", "--ancestry-path", f"{commit}..HEAD"
    )
    if first is None or later is None:
        raise ValueError(f"commit {commit}: unknown in this clone; see `git log`")
    if not later and first != read_head():
        raise ValueError(
            f"commit {commit}: not in the history of HEAD; use one that `git log` lists"
        )
    return {first, *later.split()}


def count_commits_since(commit: str) -> int | None:
    """Return how many commits HEAD has that a commit does not contain."""
    count = run_git("rev-list", "--count", f"{commit}..HEAD")
    return None if count is None else int(count)


def find_oldest(commits: Sequence[str]) -> tuple[str, int] | None:
    """Return the oldest of some commits and its age in commits; None if one of them is unknown."""
    ages: dict[str, int] = {}
    for commit in commits:
        age = count_commits_since(commit)
        if age is None:
            return None
        ages[commit] = age
    return max(ages.items(), key=lambda item: item[1])


def list_changes_since(commit: str) -> list[str]:
    """Return what has changed in the working tree that can change a figure: packages of softfin,
    uv.lock and so on."""
    paths = run_git("diff", "--name-only", commit, "--", *FIGURE_INPUTS) or ""
    return sorted(
        {path.removeprefix("src/softfin/").partition("/")[0] for path in paths.splitlines()}
    )


def describe_age(commits: Sequence[str]) -> str:
    """Return the age of a figure as documents state it, such as ``14 commits old on
    2026-11-24``."""
    oldest = find_oldest(commits)
    if oldest is None:
        return UNKNOWN_AGE
    return f"{format_age(oldest[1])} on {time.strftime('%Y-%m-%d')}"


def format_age(num_commits: int) -> str:
    """Return an age such as ``14 commits old``."""
    return f"{num_commits} commit{'' if num_commits == 1 else 's'} old"
