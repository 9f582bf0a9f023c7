import json

import pytest

from softfin.core.errors import ArtifactError, ConfigurationError
from softfin.data.collect import open_to_extend
from softfin.storage.dataset import write_dataset
from tests.storage.test_dataset import make_log

TANK = {"plant": "tank", "plant_identity": "softfin.tank 1"}


@pytest.fixture
def recorded(tmp_path):
    """Makes a dataset with such metadata."""

    def make(**metadata):
        write_dataset(tmp_path / "data", [make_log(0)], [], metadata, overwrite=True)
        return tmp_path / "data"

    return make


def test_a_dataset_of_the_same_plant_is_opened(recorded):
    assert len(open_to_extend(recorded(**TANK), TANK).train) == 1


def test_the_same_plant_under_another_name_is_the_same(recorded):
    assert open_to_extend(recorded(**TANK), TANK | {"plant": "fin.yaml"})


def test_where_only_a_name_is_known_the_name_counts(recorded):
    assert open_to_extend(recorded(plant="tank"), TANK)
    with pytest.raises(
        ConfigurationError, match="data: recorded of pool, not of tank as it is now; logs of two plants do not mix"
    ):
        open_to_extend(recorded(plant="pool"), TANK)


def test_another_plant_is_refused(recorded):
    with pytest.raises(
        ConfigurationError, match=r"data: recorded of pool, not of tank as it is now; .* do not mix: collect anew"
    ):
        open_to_extend(recorded(plant="pool", plant_identity="pool 3"), TANK)


def test_a_plant_that_has_changed_under_its_name_is_refused(recorded):
    with pytest.raises(ConfigurationError, match="data: recorded of tank, not of tank as it is now; logs of two"):
        open_to_extend(recorded(plant="tank", plant_identity="softfin.tank 2"), TANK)


def test_the_identity_that_an_earlier_version_wrote_is_known(recorded):
    assert open_to_extend(recorded(**TANK | {"plant_identity": "softfin.tank 0"}), TANK, "softfin.tank 0")


def test_a_dataset_that_names_no_plant_says_how_to_name_it(recorded):
    path = recorded()
    with pytest.raises(ConfigurationError, match=r'has no name, write "plant": "tank" into it'):
        open_to_extend(path, TANK)
    description = json.loads((path / "dataset.json").read_text())
    (path / "dataset.json").write_text(json.dumps(description | {"plant": "tank"}))
    assert open_to_extend(path, TANK)


def test_a_damaged_dataset_is_refused(recorded):
    path = recorded(**TANK)
    log = path / "train" / "0000.parquet"
    log.write_bytes(log.read_bytes()[:-9])
    with pytest.raises(ArtifactError, match=r"train/0000\.parquet: truncated or changed since"):
        open_to_extend(path, TANK)
