import subprocess
import sys

import softfin


def test_every_public_name_is_there():
    for name in softfin.__all__:
        assert getattr(softfin, name) is not None
    assert callable(softfin.reproduce)


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
