"""``python -m softfin.cli`` is ``softfin``."""

from softfin.cli import main

main()
