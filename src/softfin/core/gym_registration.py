"""Registers ``softfin/ForceTracking-v0`` with Gymnasium. The environment itself is imported when it
is created."""

ID = "softfin/ForceTracking-v0"


def register() -> None:
    """Register the environment; imports Gymnasium. A second call does nothing."""
    import gymnasium

    if ID not in gymnasium.registry:
        gymnasium.register(ID, entry_point="softfin.gym:ForceTrackingEnv")
