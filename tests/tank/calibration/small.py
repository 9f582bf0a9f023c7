"""A tank of two plates, coarse in time, and short segments: a calibration of seconds."""

from softfin.tank.calibration.config import CalibrateConfig, every_range

TRUTH = {"fin.youngs_modulus_pa": 5e6, "water.drag_coefficient": 4.0, "recording.angle_gain": 0.8}
RANGES = {
    "fin.youngs_modulus_pa": (1e6, 3e7),
    "water.drag_coefficient": (1.0, 10.0),
    "recording.angle_gain": (0.5, 1.5),
}
CONFIG = CalibrateConfig.build(
    {
        "parameters": every_range(RANGES),
        "tank": {
            "fin": {"plates": 2, "youngs_modulus_pa": 8e6},
            "water": {"drag_coefficient": 6.0},
            "steps_per_tick": 1,
        },
        "evaluations": 24,
        "iterations": 12,
        "segments": 6,
        "test_segments": 2,
        "segment_s": 5.0,
        "warm_up_s": 2.0,
    }
)
