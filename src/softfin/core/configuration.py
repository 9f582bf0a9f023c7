"""Configuration: frozen pydantic models whose defaults are the paper's; YAML or ``path=value`` change them."""

import difflib
import reprlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import pydantic
import yaml

from softfin.core.errors import ConfigurationError
from softfin.core.files import read_bytes
from softfin.storage.paths import check_readable

# Not typing.Self: the run-time check of the tests decorates functions one by one, and cannot know their class.
Config = TypeVar("Config", bound="Configuration")

_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxlong, _SHORT.maxother = 2, 200, 40, 200

LARGEST_YAML = 100_000
"""Bytes; PyYAML takes two seconds for as many, and the longest file of softfin's has a few thousand."""

DEEPEST_YAML = 20
"""Levels; the deepest configuration has five. PyYAML's time grows with their square."""

MOST_MERGED = 10_000
"""Entries that ``<<`` may bring in: a few lines of merges can stand for more than fits into memory."""

_UNREADABLE = (yaml.YAMLError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
"""What PyYAML raises: the 99th of a month, an empty !!int and a long !!float are none of its own errors."""


class Configuration(pydantic.BaseModel):
    """Base of every stage's configuration: frozen, hashable, validated when built, unknown keys are errors."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)

    @classmethod
    def build(cls: type[Config], values: Mapping[str, Any], source: str = "configuration") -> Config:
        """From nested mappings; raises ConfigurationError that names the key, the value and what is allowed."""
        try:
            return cls.model_validate(values)
        except pydantic.ValidationError as error:
            raise ConfigurationError(f"{source}: {_explain(cls, error)}") from None

    def changed(self: Config, changes: Sequence[str]) -> Config:
        """With ``path=value`` changes applied, such as ``reward.smoothness=0.2``; values are read as YAML."""
        values = self.model_dump()
        for change in changes:
            path, sign, text = change.partition("=")
            if not sign:
                raise ConfigurationError(f"--set {change}: no '='; write path=value, for example {_example(self)}")
            *parents, leaf = path.strip().split(".")
            node = values
            for parent in parents:
                if not isinstance(node.get(parent), dict):
                    raise ConfigurationError(f"--set {change}: there is no group {parent!r}{_nearest(parent, node)}")
                node = node[parent]
            if leaf not in node:
                raise ConfigurationError(f"--set {change}: there is no {leaf!r}{_nearest(leaf, node)}")
            try:
                node[leaf] = parse_yaml(text)
            except ValueError as error:
                raise ConfigurationError(
                    f"--set {_short(change)}: not YAML ({error}); quote it, or close its bracket"
                ) from None
        return self.build(values, "--set")

    def merged(self: Config, values: Mapping[str, Any], source: str) -> Config:
        """With a mapping, such as a part of a YAML file, laid over this configuration."""
        return self.build(_merge(self.model_dump(), values), source)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file."""
    check_readable(path)
    try:
        values = parse_yaml(read_bytes(path, LARGEST_YAML).decode())
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise ConfigurationError(f"{path}: not YAML ({error})") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigurationError(f"{path}: holds a {type(values).__name__}; it must be a mapping of names to values")
    return values


def parse_yaml(text: str, largest: int = LARGEST_YAML) -> Any:
    """A YAML value; raises ValueError in one line for anything else, and for what is too long, too deep or too wide.

    All YAML that softfin reads goes through here, that of ROS 2 bags before their reader gets it.
    """
    if len(text) > largest:
        raise ValueError(f"it has {len(text):,} characters, over {largest:,}")
    try:
        return yaml.load(text, _Loader)
    except _UNREADABLE as error:
        raise ValueError(" ".join(str(error).split())[:500] or type(error).__name__) from None


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, with an end in sight."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = self._merged = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """One node and all within it."""
        self._depth += 1
        if self._depth > DEEPEST_YAML + 1:
            raise yaml.YAMLError(f"nested more than {DEEPEST_YAML} deep")
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Put in what ``<<`` brings."""
        for key, value in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                for source in value.value if isinstance(value, yaml.SequenceNode) else [value]:
                    if isinstance(source, yaml.MappingNode):
                        self.flatten_mapping(source)
                        self._merged += len(source.value)
                        if self._merged > MOST_MERGED:
                            raise yaml.YAMLError(f"<< brings in more than {MOST_MERGED:,} entries")
        super().flatten_mapping(node)


def _merge(base: dict[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        inner = base.get(key)
        merged[key] = _merge(inner, value) if isinstance(inner, dict) and isinstance(value, Mapping) else value
    return merged


def _explain(cls: type[pydantic.BaseModel], error: pydantic.ValidationError) -> str:
    errors = error.errors(include_url=False)
    # Where a value may be one of several configurations, pydantic tries each: meant is the one that fits best.
    tried = Counter(_alternative(each["loc"]) for each in errors)
    meant = min(tried, key=lambda each: (each is not None, tried[each]))
    # A misspelt key is a missing one, too: what was written says more than what was not.
    first = min(
        (each for each in errors if _alternative(each["loc"]) == meant),
        key=lambda each: each["type"] != "extra_forbidden",
    )
    place = [part for part in first["loc"] if part != meant]
    *parents, leaf = place or ("",)
    name = ".".join(str(part) for part in place)
    if first["type"] == "extra_forbidden":
        model: Any = cls
        for parent in parents:
            field = getattr(model, "model_fields", {}).get(str(parent))
            model = field.annotation if field else None
        fields = dict.fromkeys(model.model_fields) if hasattr(model, "model_fields") else {}
        return f"unknown key {name!r}{_nearest(str(leaf), fields) if fields else ''}"
    if first["type"] == "missing":
        # Its input is the mapping that lacks it.
        return f"{name}: is required, and missing"
    if first["type"] == "value_error" and isinstance(first["input"], Mapping):
        # Of a whole model: its validator names what is wrong, and its input is everything.
        return f"{name}: {first['ctx']['error']}" if name else str(first["ctx"]["error"])
    return f"{name or 'value'} = {_short(first['input'])}: {first['msg']}"


def _alternative(place: Sequence[int | str]) -> str | None:
    """What pydantic calls the configuration that it tried, among the names of fields: ``FitConfig``."""
    return next((part for part in place if isinstance(part, str) and part.rstrip("]").endswith("Config")), None)


def _short(value: object) -> str:
    """One line of it, however large it is: a few lines of YAML can stand for more than fits into memory."""
    try:
        return _SHORT.repr(value)
    except ValueError:
        # Of an integer with more digits than Python cares to write.
        return f"<{type(value).__name__} of too many digits>"


def _nearest(name: str, allowed: Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(name, list(allowed), n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; there are {', '.join(allowed)}"


def _example(config: pydantic.BaseModel) -> str:
    name, value = next(iter(config.model_dump().items()))
    return f"{name}={value}"
