"""The evidence: what README and docs state, run by ``python -m results``, kept as one JSON a part,
put into them."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
