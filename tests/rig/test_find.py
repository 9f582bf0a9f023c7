import pytest
import yaml

from softfin.core.errors import RigError
from softfin.rig.find import find_bench
from softfin.rig.rig import Rig
from tests.rig.test_config import VALUES, written


def test_a_rig_is_found_by_its_file_without_being_opened(tmp_path):
    bench = find_bench(f"rig:{written(tmp_path)}")
    assert isinstance(bench.machine, Rig)
    assert (bench.fin, bench.machine.name) == ("blue", "rig of blue")
    assert bench.described["sensor"]["address"] == "192.168.1.1"
    assert "emulation" not in bench.described
    assert bench.machine.counters()["drive_targets_repeated"] == 0


def test_the_file_beside_one_is_the_default(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(VALUES))
    assert find_bench("rig").fin == "blue"
    with pytest.raises(RigError, match=r"ros2\.yaml: no such file"):
        find_bench("ros2")


def test_another_name_says_what_there_is():
    with pytest.raises(RigError, match="plant tank: not a real fin; give rig or ros2, or one of these with :FILE"):
        find_bench("tank")
