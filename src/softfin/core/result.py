"""Results of stages: a mapping for programs and a text for people."""

from collections.abc import Mapping
from typing import Any


class Result(dict[str, Any]):
    """Contents of the JSON file of a stage; printing it shows the text of the command."""

    def __init__(self, values: Mapping[str, Any], text: str) -> None:
        super().__init__(values)
        self.text = text
        """Text that the command prints."""

    def __str__(self) -> str:
        return self.text
