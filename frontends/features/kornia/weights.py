"""Checkpoints of the learned parts: where they are sought, and whether they fit. Nothing is downloaded."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from dualslam.core.errors import ConfigError
from dualslam.frontends.features.kornia.checkpoints import Checkpoint


@dataclass(frozen=True, slots=True)
class WeightSource:
    """Where the user wants checkpoints to be sought.

    Attributes
    ----------
    field : str
        The option that says so, for messages.
    path : Path or None
        A file, where `is_single`; a folder; or None: torch's cache.
    is_single : bool
        Whether only one checkpoint is needed, so that a file can be named.
    """

    field: str
    path: Path | None
    is_single: bool

    def find(self, checkpoint: Checkpoint) -> Path:
        """Return the file.

        Raises
        ------
        ConfigError
            It is not there: the message says where it was sought and where it is published.
        """
        published = f"{checkpoint.part} is published at {checkpoint.url}"
        if self.path is None:
            path = Path(torch.hub.get_dir()) / "checkpoints" / checkpoint.file
            if not path.is_file():
                raise ConfigError(
                    f"{self.field}: {path} is not there. Nothing is downloaded: {published}; put it there, or name "
                    "the file by this option"
                )
            return path
        if self.path.is_file() and not self.is_single:
            raise ConfigError(
                f"{self.field}: more than one checkpoint is needed: name the folder that holds them, among them "
                f"{checkpoint.file} ({published})"
            )
        path = self.path / checkpoint.file if self.path.is_dir() else self.path
        if not path.is_file():
            raise ConfigError(f"{self.field}: {path} is not there ({published})")
        return path

    def load(self, checkpoint: Checkpoint, module: torch.nn.Module, rename: Mapping[str, str] | None = None) -> None:
        """Find a checkpoint and put it into a module, which is then ready to be used.

        Parameters
        ----------
        checkpoint : Checkpoint
        module : torch.nn.Module
        rename : mapping, optional
            Old starts of the names of the state to new ones, where the publisher called them otherwise.

        Raises
        ------
        ConfigError
            It is not there, cannot be read, or does not fit.
        """
        path = self.find(checkpoint)
        state = _read(path, checkpoint, self.field)
        for old, new in (rename or {}).items():
            state = {new + name[len(old) :] if name.startswith(old) else name: each for name, each in state.items()}
        misfit = f"{self.field}: {path} does not fit {checkpoint.part}"
        try:
            missing = module.load_state_dict(state, strict=False).missing_keys
        except RuntimeError as error:
            # torch's text: a heading, then a line for each tensor of another shape.
            raise ConfigError(f"{misfit}: {str(error).splitlines()[-1].strip()}") from error
        # What a module derives from its options (thresholds, fixed filters) is not in every publisher's file.
        learned = {name for name, _ in module.named_parameters()}
        absent = [name for name in missing if name in learned or name.endswith(("running_mean", "running_var"))]
        if absent:
            raise ConfigError(f"{misfit}: {len(absent)} of its {len(learned)} tensors are missing, first {absent[0]}")
        module.eval()


def _read(path: Path, checkpoint: Checkpoint, field: str) -> dict[str, Any]:
    """Read the state from a file, bare or as it is published."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise ConfigError(f"{field}: {path} cannot be read as a checkpoint of torch: {reason[0]}") from error
    if isinstance(content, dict) and isinstance(content.get(checkpoint.key), dict):
        content = content[checkpoint.key]
    if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
        raise ConfigError(f"{field}: {path} holds no named tensors, so it is no checkpoint of {checkpoint.part}")
    return content
