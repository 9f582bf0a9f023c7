"""The public names are those of `public.txt`: a line may be added to it, but from 1.0.0 on none may
change or go before CHANGELOG.md has announced it for a minor version. Write it anew with ``pytest
tests/test_public.py --rewrite``."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import softfin
import softfin.gym
import softfin.testing
from softfin.core.configuration import Configuration

FROZEN = Path(__file__).with_name("public.txt")


def parameters(function: object) -> str:
    """The names and defaults of a function's parameters."""
    signature = inspect.signature(function)
    stripped = [each.replace(annotation=each.empty) for each in signature.parameters.values()]
    # The address of an object differs in each process.
    return re.sub(r"<.*?>", "...", str(inspect.Signature(stripped)))


def members(kind: type) -> set[str]:
    """What a class of softfin has, and how its methods are called."""
    lines = set()
    for base in kind.__mro__:
        if base.__module__.startswith("softfin"):
            for name in [*vars(base), *vars(base).get("__annotations__", ())]:
                value = inspect.getattr_static(kind, name, None)
                if not name.startswith("_"):
                    lines.add(name + (parameters(value) if inspect.isfunction(value) else ""))
    return lines


def public_lines() -> list[str]:
    named = {f"softfin.{name}": getattr(softfin, name) for name in softfin.__all__}
    for name in softfin.testing.__all__:
        named[f"softfin.testing.{name}"] = getattr(softfin.testing, name)
    named["softfin.gym.ForceTrackingEnv"] = softfin.gym.ForceTrackingEnv
    lines = []
    for name, value in named.items():
        if inspect.isfunction(value):
            lines.append(name + parameters(value))
        elif inspect.isclass(value):
            # The fields of configurations are in limits.txt, and in the help of the commands. What a
            # plant has beside the interface is its own.
            is_plant = hasattr(value, "advance")
            own = members(softfin.Plant if is_plant else value)
            if issubclass(value, Configuration):
                own = set()
            lines += [name, *(f"{name}.{member}" for member in own)]
        else:
            lines.append(name)
    return sorted(lines)


def test_the_public_names_are_those_on_file(request):
    lines = public_lines()
    if request.config.getoption("--rewrite"):
        FROZEN.write_text("\n".join([*lines, ""]))
    assert lines == FROZEN.read_text().splitlines()


def test_every_public_function_has_its_parameters_and_one_example():
    functions = [getattr(softfin, name) for name in softfin.__all__]
    functions += [getattr(softfin.testing, name) for name in softfin.testing.__all__]
    for function in filter(inspect.isfunction, functions):
        text = inspect.getdoc(function)
        assert text.count("\nExample:\n    >>> ") == 1, function
        for name in set(inspect.signature(function).parameters) - {"progress"}:
            assert re.search(rf"^    \*?{name}: ", text, re.MULTILINE), (function, name)


def test_importing_softfin_and_asking_for_help_imports_nothing_heavy():
    """Gymnasium may be absent."""
    code = (
        "import sys, softfin, softfin.cli\n"
        "try: softfin.cli.main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'jax', 'numpy', 'matplotlib', 'pyarrow', 'gymnasium', 'pydantic'} & "
        "set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "assert softfin.Limits.__module__ == 'softfin.core.quantities'\n"
        "sys.modules['gymnasium'] = None\n"
        "try: import gymnasium\n"
        "except ImportError: pass\n"
        "else: raise AssertionError\n"
        "del sys.modules['gymnasium']\n"
        "import gymnasium.spaces\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, capture_output=True)


def test_the_environment_is_known_to_gymnasium():
    """Gymnasium 1 loads no plugins by entry points; the module in front of the ID is what it has
    instead."""
    known = (
        "import sys; gymnasium.spec('softfin/ForceTracking-v0'); assert not {'jax', "
        "'matplotlib'} & set(sys.modules)"
    )
    for code in (
        f"import gymnasium, softfin; {known}; "
        "gymnasium.make('softfin.gym:softfin/ForceTracking-v0')",
        "import gymnasium; gymnasium.make('softfin:softfin/ForceTracking-v0')",
    ):
        subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, capture_output=True)
