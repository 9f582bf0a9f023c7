import subprocess
import sys

import softfin


def test_every_public_name_is_there():
    for name in softfin.__all__:
        assert getattr(softfin, name) is not None
    assert callable(softfin.reproduce)


def test_importing_softfin_and_asking_for_help_imports_nothing_heavy():
    code = (
        "import sys, softfin, softfin.cli\n"
        "try: softfin.cli.main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'jax', 'numpy', 'matplotlib', 'pyarrow', 'gymnasium', 'tyro'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
