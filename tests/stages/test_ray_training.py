"""Many trainings on Ray, where it is installed and a network of its own can be had."""

import sys
from pathlib import Path

import pytest

from softfin.core.errors import ConfigurationError
from softfin.stages.ray_training import train_on_ray
from tests import needs
from tests.alone import namespace, told_by


def test_without_ray_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigurationError, match=r"^Ray is not installed; .*pip install .*\[ray\]"):
        train_on_ray([], "127.0.0.1:6399")


@pytest.mark.slow
def test_a_cluster_trains_the_same_bits_and_a_failure_is_told_after_the_others_finished(
    tmp_path: Path,
) -> None:
    needs.module("ray", "the extra ray is not installed")
    if not namespace():
        needs.give_up("ray", "Ray is tried in a network namespace, and none can be had here")
    told = told_by(
        "tests.stages.ray_cluster",
        tmp_path,
        HOME=str(tmp_path),
        RAY_USAGE_STATS_ENABLED="0",
        RAY_ENABLE_UV_RUN_RUNTIME_ENV="0",
    )
    assert told["trained"] == [told["alone"], told["other"]]
    assert told["alone"] != told["other"]
    assert "taken: already exists" in told["error"]
    assert told["finished"]
