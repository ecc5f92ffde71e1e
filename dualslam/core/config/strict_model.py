"""The base of every section of the configuration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from dualslam.core.config.problems import sentence
from dualslam.core.errors import ConfigError


class StrictModel(BaseModel):
    """A frozen section of the config that refuses unknown fields.

    Raises `ConfigError`: one sentence: which field, what is wrong with it. (pydantic's own `model_validate` and
    `model_validate_json` raise pydantic's error.)
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    def __init__(self, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise ConfigError(f"{type(self).__name__}: {sentence(error, type(self))}") from error

    # pydantic's mark of an __init__ that only validates: sections within sections are then made as strictly as ever.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    if not TYPE_CHECKING:

        def __setattr__(self, name: str, value: object) -> None:
            raise ConfigError(
                f"{type(self).__name__}.{name} cannot be changed, a configuration is frozen: make a new one, with "
                "load_config(overrides=[...]) or with model_copy(update={...})."
            )

    def with_section(self, section: str, /, **values: Any) -> Self:
        """Return a copy in which fields of a section have other values."""
        return self.model_copy(update={section: getattr(self, section).model_copy(update=values)})

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with other values in some fields, which are checked as all are."""
        copied = super().model_copy(deep=deep)
        if not update:
            return copied
        return type(self)(**{name: getattr(copied, name) for name in type(self).model_fields} | dict(update))
