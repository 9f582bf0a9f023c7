"""Configuration: frozen pydantic models with the paper's values as defaults, changed by YAML or
``path=value``."""

import difflib
import re
import reprlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, TypeVar, get_args, get_origin

import pydantic
import yaml

from softfin.core.errors import ConfigurationError, one_line
from softfin.core.json_object import JsonObject

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    # pydantic has no public name for this class.
    ModelMetaclass = type(pydantic.BaseModel)

# Not typing.Self: the run-time type check in the tests decorates functions individually, without
# their class.
Config = TypeVar("Config", bound="Configuration")


class _OneLineErrors(ModelMetaclass):
    """Metaclass of the configuration classes: constructor calls raise ConfigurationError with a
    one-line message. Validation within pydantic does not use it."""

    def __call__(cls, *args: object, **values: object) -> Any:
        try:
            return super().__call__(*args, **values)
        except pydantic.ValidationError as error:
            raise ConfigurationError(f"{cls.__name__}: {_explain(cls, error, values)}") from error


class Configuration(pydantic.BaseModel, metaclass=_OneLineErrors):
    """Base class of every stage's configuration: frozen, hashable and validated on construction.
    Unknown keys are errors."""

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False
    )

    @classmethod
    def build(
        cls: type[Config], values: Mapping[str, object], source: str = "configuration"
    ) -> Config:
        """Build from nested mappings; raises ConfigurationError with the key, the value and the
        allowed values."""
        try:
            return cls.model_validate(values)
        except pydantic.ValidationError as error:
            raise ConfigurationError(f"{source}: {_explain(cls, error, values)}") from None

    def changed(self: Config, changes: Sequence[str]) -> Config:
        """Return a copy with ``path=value`` changes, such as ``reward.smoothness=0.2``; values are
        parsed as YAML."""
        return Changes(None, dict(change.split("=", 1) for change in changes)).apply(self)

    def merged(self: Config, values: Mapping[str, object], source: str) -> Config:
        """Return a copy with a mapping, such as part of a YAML file, merged into it. Fields that
        are set in neither remain unset (`model_fields_set`)."""
        return self.build(_merge(self, values), source)


class Changes(NamedTuple):
    """Changes that the user typed: a file, and single fields, which take precedence."""

    file: Path | None
    """YAML file."""
    fields: Mapping[str, str]
    """Text of each field, keyed by option, such as ``--excitation.hold-min-s``; parsed as YAML."""
    options: Sequence[str] = ()
    """Other options of the command, suggested for misspelled names."""

    def apply(self, base: Config) -> Config:
        """Return `base` with the changes; raises ConfigurationError for an unknown field."""
        config = base if self.file is None else base.merged(read_yaml(self.file), str(self.file))
        values: JsonObject = {}
        for option, text in self.fields.items():
            path = option.removeprefix("--").replace("-", "_").split(".")
            if path[0] not in type(base).model_fields:
                names = [f"--{name.replace('_', '-')}" for name in type(base).model_fields]
                nearest = suggest_option(option, [*self.options, *names])
                raise ConfigurationError(f"{option}: unknown option; {nearest}")
            try:
                value = parse_yaml(text)
            except ValueError as error:
                raise ConfigurationError(
                    f"{option} {text[:200]}: not valid YAML ({error}); quote the value, or close "
                    "its bracket"
                ) from None
            for name in reversed(path):
                value = {name: value}
            values = _merge(values, value)
        return config.merged(values, "options")


RENAMED: Mapping[str, str] = {"trim": "feedback"}
"""New names of options and keys, keyed by the old names."""


def suggest_option(option: str, options: Sequence[str]) -> str:
    """Return the end of a message about an unknown option."""
    name, *fields = option.removeprefix("--").replace("_", "-").split(".")
    if name in RENAMED:
        return f"it is now --{'.'.join([RENAMED[name], *fields])}"
    names = [each.removeprefix("--") for each in options]
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean --{close[0]}?" if close else "--help lists the options"


Settings: TypeAlias = Configuration | Changes | Mapping[str, Any] | Path | str | None
"""Configuration that a stage accepts: a complete one, or changes to the default."""


def configure(base: Config, given: Settings, **options: object) -> Config:
    """Return the configuration of a stage; options that are not None override `given`.

    `given` is a configuration, which replaces `base`, or changes to `base`, as a mapping or a YAML
    file. Raises ConfigurationError if a value is invalid.
    """
    if isinstance(given, Configuration):
        if type(given) is not type(base):
            raise ConfigurationError(
                f"config: is of type {type(given).__name__}; use a {type(base).__name__}"
            )
        base = given
    elif isinstance(given, Changes):
        base = given.apply(base)
    elif isinstance(given, Mapping):
        base = base.merged(given, "config")
    elif isinstance(given, str | Path):
        base = base.merged(read_yaml(Path(given)), str(given))
    elif given is not None:
        raise ConfigurationError(
            f"config: is of type {type(given).__name__}; use a {type(base).__name__}, a mapping or "
            "a YAML file"
        )
    changes = {name: value for name, value in options.items() if value is not None}
    return base.merged(changes, "options") if changes else base


def option_name(field: str) -> str:
    """Return the option of a field without the unit, such as ``rate`` for ``rate_hz``."""
    return re.sub("_(hz|rad_s|ms|s|)$", "", field).replace("_", "-")


class Chosen:
    """Validator (for pydantic's BeforeValidator) of a field whose class depends on its values."""

    def __init__(self, choose: Callable[[Mapping[str, object]], type[Configuration]]) -> None:
        self.choose = choose
        """Function that returns the class for the field's values; may raise ValueError."""

    def __call__(self, values: object) -> Configuration:
        """Return the configuration for a mapping; raises pydantic's ValidationError."""
        if isinstance(values, Configuration):
            return values
        chosen = self.choose(values if isinstance(values, Mapping) else {})
        return chosen.model_validate(values)


def read_yaml(path: Path) -> JsonObject:
    """Read the mapping from a YAML file."""
    try:
        values = parse_yaml(path.read_text())
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise ConfigurationError(f"{path}: not valid YAML ({error})") from None
    if not isinstance(values, dict | None):
        raise ConfigurationError(
            f"{path}: contains a {type(values).__name__}; it must be a mapping of names to values"
        )
    return values or {}


def parse_yaml(text: str) -> Any:
    """Parse a YAML value; raises ValueError with a one-line message if the text cannot be used."""
    try:
        return yaml.safe_load(text)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ValueError(f"{error.problem}{place}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(one_line(error)) from None


def _merge(base: Configuration | JsonObject, over: Mapping[str, object]) -> JsonObject:
    values = _set_fields(base) if isinstance(base, Configuration) else base
    before: JsonObject = vars(base) if isinstance(base, Configuration) else base
    return values | {
        key: _merge(before[key], value)
        if isinstance(before.get(key), Configuration | dict) and isinstance(value, Mapping)
        else value
        for key, value in over.items()
    }


def _set_fields(base: Configuration) -> JsonObject:
    """Return the fields that are set, and those with only one possible value, by which pydantic
    recognizes the class."""
    names = [
        name
        for name, field in type(base).model_fields.items()
        if name in base.model_fields_set
        or (get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1)
    ]
    return {name: vars(base)[name] for name in names}


def _explain(cls: Any, error: pydantic.ValidationError, values: Mapping[str, object]) -> str:
    errors = error.errors(include_url=False)
    # A misspelled key also causes a missing one; the misspelled key is the better clue.
    first = min(errors, key=lambda each: each["type"] != "extra_forbidden")
    place = first["loc"]
    *parents, leaf = place or ("",)
    name = ".".join(map(str, place))
    if first["type"] == "extra_forbidden":
        model: Any = cls
        part: Any = values
        for parent in parents:
            field = getattr(model, "model_fields", {}).get(str(parent))
            part = part.get(parent, {}) if isinstance(part, Mapping) else {}
            model = _field_class(field, part) if field else None
        fields = dict.fromkeys(model.model_fields) if hasattr(model, "model_fields") else {}
        return f"unknown key {name!r}{_nearest(str(leaf), fields) if fields else ''}"
    if first["type"] == "missing":
        # For this error, the input is the mapping without the key.
        return f"{name}: missing required key"
    if first["type"] == "value_error" and isinstance(first["input"], Mapping):
        # This error concerns an entire model. The validator message describes the problem; the
        # input is the entire mapping and is not shown.
        return f"{name}: {first['ctx']['error']}" if name else str(first["ctx"]["error"])
    problem = first["msg"]
    if first["type"] == "tuple_type":
        problem = "must be a list such as [0.5, 1.57]"
    return f"{name or 'value'} = {reprlib.repr(first['input'])[:200]}: {problem}"


def _field_class(field: pydantic.fields.FieldInfo, values: Any) -> Any:
    """Return the class of a field, which may depend on its values."""
    for validator in field.metadata:
        function = getattr(validator, "func", None)
        if isinstance(function, Chosen):
            return function.choose(values)
    return field.annotation


def _nearest(name: str, allowed: Mapping[str, object]) -> str:
    close = difflib.get_close_matches(RENAMED.get(name, name), list(allowed), n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; available: {', '.join(allowed)}"
