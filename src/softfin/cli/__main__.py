"""``python -m softfin.cli`` is ``softfin``."""

from softfin.cli import script

script()
