"""How the built-in front ends come from the config."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

from pydantic import BaseModel

from dualslam.frontends.registry import parse_options


class OptionedFrontend:
    """A front end that is made of a number of features and its own strict options.

    `n_features`: keypoints per image, at most.
    """

    name: str
    options_model: ClassVar[type[BaseModel]]  # of its options

    def __init__(self, n_features: int = 1500, options: Any = None) -> None:
        self.n_features = n_features
        self.options = options or self.options_model()

    @classmethod
    def from_options(cls, n_features: int, options: Mapping[str, Any]) -> Self:
        """Build from the config; ConfigError names an option that is unknown, out of range or cannot be met."""
        return cls(n_features, parse_options(cls.options_model, cls.name, options))
