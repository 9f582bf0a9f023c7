"""softfin: learn to make the force that you ask a soft fin for.

The stages of the main job, the records that pass between them, and what plants and controllers are:

    import softfin

    softfin.collect("tank", Path("dataset"))
    softfin.fit(Path("dataset"), Path("surrogate"))
    softfin.train("surrogate", Path("controller"))
    softfin.evaluate(Path("controller"), "tank", Path("evaluation"))

``__init__.pyi`` lists the public names; each is imported when it is first used, so that ``import
softfin`` costs nothing. Gymnasium makes the environment ``softfin.gym:softfin/ForceTracking-v0``;
where it was imported before softfin, ``softfin/ForceTracking-v0`` will do.
"""

import sys

import lazy_loader

from softfin.core.gym_registration import register

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

if "gymnasium" in sys.modules:
    register()
