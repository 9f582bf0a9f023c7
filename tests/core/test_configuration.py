from typing import Annotated, Literal

import pytest
from pydantic import Field, model_validator

from softfin.core.configuration import Changes, Configuration, configure, read_yaml
from softfin.core.errors import ConfigurationError


class Inner(Configuration):
    rate: float = Field(default=0.1, gt=0)
    name: str = "a"


class Outer(Configuration):
    inner: Inner = Inner()
    steps: int = 3
    pair: tuple[float, float] = (0.5, 1.57)


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
    assert str(error.value) == "options: low must not be above high"
    with pytest.raises(ConfigurationError) as error:
        Group().changed(["ordered.low=2"])
    assert str(error.value) == "options: ordered: low must not be above high"


class Needed(Configuration):
    inner: Inner
    gear: float


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"inner": {}}, "rig.yaml: gear: missing required key"),
        ({"inner": {}, "geer": 2.0}, "rig.yaml: unknown key 'geer'; did you mean 'gear'?"),
    ],
)
def test_a_missing_key_is_named_alone_and_a_misspelt_one_as_it_was_written(values, words):
    with pytest.raises(ConfigurationError) as error:
        Needed.build(values, "rig.yaml")
    assert str(error.value) == words


def test_values_change_by_path_and_the_original_stays():
    config = Outer()
    assert config.changed(["inner.rate=0.5", "steps=7"]) == Outer(inner=Inner(rate=0.5), steps=7)
    assert config.changed(["inner={rate: 0.5}"]) == Outer(inner=Inner(rate=0.5))
    assert config == Outer()


def test_equal_configurations_hash_equal_so_that_programs_are_compiled_once():
    assert hash(Outer(steps=4)) == hash(Outer().changed(["steps=4"]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("step=4", "step: unknown option; did you mean --steps?"),
        ("iner.rate=1", "iner.rate: unknown option; did you mean --inner?"),
        ("trim.drift_n=1", r"trim.drift_n: unknown option; it is now --feedback\.drift-n$"),
        ("inner.rat=1", "unknown key 'inner.rat'; did you mean 'rate'?"),
        ("steps.x=1", "steps = {'x': 1}: Input should be a valid integer"),
        ("inner.rate=-1", r"inner.rate = -1: Input should be greater than 0"),
        ("steps=many", "steps = 'many': Input should be a valid integer"),
        ("steps=[1", r"not valid YAML \(expected ',' or '\]', .*, line 1, column 3\);"),
        ("pair=1,2", r"pair = '1,2': must be a list such as \[0.5, 1.57\]"),
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
        ("- 1", "contains a list; it must be a mapping"),
        ("a: [", "not valid YAML"),
        ("steps: 2026-02-99", "not valid YAML"),
        pytest.param("a: " + "[" * 5000, "not valid YAML", id="too deep"),
        ("a: !!python/object:os.system x", "not valid YAML"),
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


def test_an_option_wins_over_a_field_which_wins_over_the_file(tmp_path):
    file = tmp_path / "run.yaml"
    file.write_text("steps: 5\ninner: {rate: 0.25, name: b}\n")
    typed = Changes(file, {"--inner.rate": "0.5"})
    assert configure(Outer(), typed) == Outer(steps=5, inner=Inner(rate=0.5, name="b"))
    assert configure(Outer(), typed, steps=7).steps == 7
    assert configure(Outer(), str(file), steps=None).steps == 5
    assert configure(Outer(), {"inner": {"name": "c"}}).inner == Inner(name="c")
    assert configure(Outer(), Outer(steps=9)).steps == 9


class Tuned(Configuration):
    inner: Inner = Inner(rate=0.7)


class Deep(Configuration):
    tuned: Tuned = Tuned()
    optional: Inner | None = None


def test_a_field_that_equals_its_default_is_known_to_be_set():
    typed = Changes(None, {"--optional.rate": "0.1"})
    config = configure(Deep(), typed, optional={})
    assert config == Deep(optional=Inner())
    assert config.model_fields_set == {"optional"}
    assert config.optional.model_fields_set == {"rate"}
    assert configure(Deep(), None, optional={}).optional.model_fields_set == set()


def test_fields_that_are_not_set_keep_the_values_of_the_default_around_them():
    config = configure(Deep(), {"tuned": {"inner": {"name": "b"}}})
    assert config == Deep(tuned=Tuned(inner=Inner(rate=0.7, name="b")))


def test_the_configuration_of_something_else_is_refused():
    with pytest.raises(ConfigurationError, match="config: is of type Inner; use a Outer"):
        configure(Outer(), Inner())


def test_a_misspelt_field_may_be_an_option_of_the_command():
    with pytest.raises(ConfigurationError, match="--overwrit: unknown option; did you mean --over"):
        Changes(None, {"--overwrit": "1"}, ["--overwrite"]).apply(Outer())


def test_some_aliases_are_fine_and_an_empty_file_is_empty(tmp_path):
    file = tmp_path / "good.yaml"
    file.write_text("a: &a {k: 1}\nb: {<<: *a, l: [*a, *a]}\n")
    assert read_yaml(file) == {"a": {"k": 1}, "b": {"k": 1, "l": [{"k": 1}, {"k": 1}]}}
    file.write_text("# nothing\n")
    assert read_yaml(file) == {}


def test_a_long_value_is_shortened_before_it_is_written_out():
    values = [1]
    for _ in range(30):
        values = [values] * 9
    with pytest.raises(ConfigurationError) as error:
        Outer.build({"steps": values})
    assert len(str(error.value)) < 400


class Cat(Configuration):
    kind: Literal["cat"] = "cat"
    lives: int = 9


class Dog(Configuration):
    kind: Literal["dog"] = "dog"
    age: int = 1


Pet = Annotated[Cat | Dog, Field(discriminator="kind")]


class Owner(Configuration):
    pet: Pet = Cat()
    others: tuple[Pet, ...] = ()


def test_merged_configurations_keep_their_class():
    """Which pydantic recognizes by a field that nobody sets."""
    owner = Owner(pet=Dog(), others=(Dog(), Cat()))
    older = owner.merged({"pet": {"age": 4}}, "test")
    assert older == Owner(pet=Dog(age=4), others=(Dog(), Cat()))
    assert older.changed(["pet.age=5"]).others == owner.others
