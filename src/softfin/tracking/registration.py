"""Makes ``softfin/ForceTracking-v0`` known to Gymnasium; the environment itself is imported when it is made."""

import gymnasium

ID = "softfin/ForceTracking-v0"


def register() -> None:
    """Idempotent."""
    if ID not in gymnasium.registry:
        gymnasium.register(ID, entry_point="softfin.tracking.gym:ForceTrackingEnv")
