import pytest
from pydantic import Field, model_validator

from softfin.core.configuration import Configuration, read_yaml
from softfin.core.errors import ConfigurationError
from softfin.stages.reproduce import ReproduceConfig


class Inner(Configuration):
    rate: float = Field(default=0.1, gt=0)
    name: str = "a"


class Outer(Configuration):
    inner: Inner = Inner()
    steps: int = 3


class Ordered(Configuration):
    low: float = 0.0
    high: float = 1.0

    @model_validator(mode="after")
    def _in_order(self):
        if self.low > self.high:
            raise ValueError("low must not be above high")
        return self


class Group(Configuration):
    ordered: Ordered = Ordered()


def test_what_a_whole_model_refuses_is_told_without_all_its_values():
    with pytest.raises(ConfigurationError) as error:
        Ordered().changed(["low=2"])
    assert str(error.value) == "--set: low must not be above high"
    with pytest.raises(ConfigurationError) as error:
        Group().changed(["ordered.low=2"])
    assert str(error.value) == "--set: ordered: low must not be above high"


class Needed(Configuration):
    inner: Inner
    gear: float


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"inner": {}}, "rig.yaml: gear: is required, and missing"),
        ({"inner": {}, "geer": 2.0}, "rig.yaml: unknown key 'geer'; did you mean 'gear'?"),
    ],
)
def test_a_missing_key_is_named_alone_and_a_misspelt_one_as_it_was_written(values, words):
    with pytest.raises(ConfigurationError) as error:
        Needed.build(values, "rig.yaml")
    assert str(error.value) == words


def test_a_few_lines_that_stand_for_more_than_fits_into_memory_are_refused_in_one_line(tmp_path):
    file = tmp_path / "run.yaml"
    lines = ["a0: &a0 [x, x]", *(f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]" for i in range(30))]
    file.write_text("\n".join(lines) + "\nsteps: *a30\n")
    values = {"steps": read_yaml(file)["steps"]}
    with pytest.raises(ConfigurationError, match=r"steps = .*: Input should be a valid integer") as error:
        Outer.build(values, "run.yaml")
    assert len(str(error.value)) < 500


def test_values_change_by_path_and_the_original_stays():
    config = Outer()
    assert config.changed(["inner.rate=0.5", "steps=7"]) == Outer(inner=Inner(rate=0.5), steps=7)
    assert config == Outer()


def test_equal_configurations_hash_equal_so_that_programs_are_compiled_once():
    assert hash(Outer(steps=4)) == hash(Outer().changed(["steps=4"]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("steps", "no '='; write path=value"),
        ("step=4", "there is no 'step'; did you mean 'steps'?"),
        ("iner.rate=1", "there is no group 'iner'; did you mean 'inner'?"),
        ("steps.x=1", "there is no group 'steps'"),
        ("inner.rate=-1", r"inner.rate = -1: Input should be greater than 0"),
        ("steps=many", "steps = 'many': Input should be a valid integer"),
        ("steps=[1", "not YAML"),
    ],
)
def test_a_wrong_change_says_what_is_allowed(change, words):
    with pytest.raises(ConfigurationError, match=words):
        Outer().changed([change])


def test_a_yaml_file_is_laid_over_the_defaults(tmp_path):
    file = tmp_path / "run.yaml"
    file.write_text("inner:\n  rate: 0.25\n")
    assert Outer().merged(read_yaml(file), "run.yaml") == Outer(inner=Inner(rate=0.25))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("inner: {rat: 1}", "unknown key 'inner.rat'; did you mean 'rate'?"),
        ("- 1", "holds a list; it must be a mapping"),
        ("a: [", "not YAML"),
        ("steps: 2026-02-99", "not YAML"),
        pytest.param("a: " + "[" * 5000, "not YAML", id="too deep"),
        ("a: !!python/object:os.system x", "not YAML"),
    ],
)
def test_a_wrong_yaml_file_is_refused_by_name(tmp_path, text, words):
    file = tmp_path / "run.yaml"
    file.write_text(text)
    with pytest.raises(ConfigurationError, match=words) as error:
        Outer().merged(read_yaml(file), str(file))
    assert "run.yaml" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_yaml_file_is_refused_by_name(tmp_path):
    with pytest.raises(ConfigurationError, match=r"nothing\.yaml: cannot be read"):
        read_yaml(tmp_path / "nothing.yaml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        # Each level costs PyYAML as much time again: a whole file of these took 24 s.
        pytest.param("a: [" + ",".join(["[" * 200 + "]" * 200] * 200) + "]", "nested more than 20 deep", id="deep"),
        pytest.param("a: " + "x" * 200_000, "over 100,000 bytes", id="long"),
        pytest.param(
            "a: &a {" + ",".join(f"k{i}: 1" for i in range(4000)) + "}\nb: [" + "{<<: *a}, " * 3000 + "]",
            "<< brings in more than 10,000 entries",
            id="merges",
        ),
        ("a: !!int ''", "not YAML"),
        ("a: !!timestamp x", "not YAML"),
        ("a: !!float " + "1:" * 400 + "1.0", "not YAML"),
    ],
)  # fmt: skip
def test_yaml_that_would_take_long_is_refused_at_once(tmp_path, text, words):
    file = tmp_path / "run.yaml"
    file.write_text(text)
    with pytest.raises(ConfigurationError, match=words) as error:
        read_yaml(file)
    assert len(str(error.value)) < 1000


@pytest.mark.parametrize("text", ["[" * 50, "[" * 5000, "x" * 200_000, "!!int ''"])
def test_a_change_is_bounded_as_a_yaml_file_is(text):
    with pytest.raises(ConfigurationError, match=r"--set .*not YAML") as error:
        Outer().changed([f"steps={text}"])
    assert len(str(error.value)) < 1000


def test_a_number_of_too_many_digits_is_refused_in_one_line():
    with pytest.raises(ConfigurationError, match=r"inner\.name = <int of too many digits>"):
        Outer().changed(["inner.name=0x" + "f" * 5000])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("fit.epochs=zwei", "--set: fit.epochs = 'zwei': Input should be a valid integer"),
        ("fit.epochs=-1", "--set: fit.epochs = -1: Input should be greater than 0"),
    ],
)
def test_of_several_configurations_the_one_that_is_meant_is_explained(change, words):
    with pytest.raises(ConfigurationError, match=words):
        ReproduceConfig().changed([change])
