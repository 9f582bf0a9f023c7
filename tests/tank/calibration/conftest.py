import pytest


@pytest.fixture(scope="module", autouse=True)
def quick_search():
    """Small generations of coarse tanks, and short blocks for short segments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("softfin.tank.calibration.calibrate.POPULATION", 6)
        patch.setattr("softfin.tank.calibration.calibrate.SEARCH_TANK", {"fin": {"plates": 2}})
        for module in ("config", "calibrate"):
            patch.setattr(f"softfin.tank.calibration.{module}.BLOCK_S", 0.5)
        yield
