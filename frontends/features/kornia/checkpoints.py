"""The published files of weights: kornia's own choice of them, and its names for them. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A published file of weights.

    Attributes
    ----------
    part : str
        What it is for, in words.
    file : str
        Its name in torch's cache, which is the one that kornia uses.
    url : str
        Where it is published.
    key : str
        Where the state stands in the file; empty: the file is the state.
    """

    part: str
    file: str
    url: str
    key: str = ""


_HUB = "https://huggingface.co/kornia"
_LIGHTGLUE = "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv"
_XFEAT = "https://github.com/verlab/accelerated_features/raw/main/weights"

KEYNET = Checkpoint("KeyNet", "keynet_pytorch.pth", f"{_HUB}/keynet/resolve/main/keynet_pytorch.pth", "state_dict")
AFFNET = Checkpoint("AffNet", "AffNet.pth", f"{_HUB}/affnet/resolve/main/AffNet.pth", "state_dict")
ORINET = Checkpoint("OriNet", "OriNet.pth", f"{_HUB}/orinet/resolve/main/OriNet.pth", "state_dict")
HARDNET = Checkpoint(
    "HardNet",
    "checkpoint_liberty_with_aug.pth",
    f"{_HUB}/hardnet/resolve/main/checkpoint_liberty_with_aug.pth",
    "state_dict",
)
XFEAT = Checkpoint("XFeat", "xfeat.pt", f"{_XFEAT}/xfeat.pt")
ALIKED = Checkpoint("ALIKED", "aliked-n16.pth", f"{_HUB}/aliked/resolve/main/aliked-n16.pth")
DISK = Checkpoint("DISK", "depth-save.pth", f"{_HUB}/disk/resolve/main/depth-save.pth", "extractor")
DEDODE_DETECTOR = Checkpoint(
    "DeDoDe's detector", "dedode_detector_L_v2.pth", f"{_HUB}/dedode/resolve/main/dedode_detector_L_v2.pth"
)
DEDODE_DESCRIPTOR = Checkpoint(
    "DeDoDe's descriptor", "dedode_descriptor_B.pth", f"{_HUB}/dedode/resolve/main/dedode_descriptor_B.pth"
)
LIGHTGLUE: Mapping[str, Checkpoint] = {
    "xfeat": Checkpoint("LightGlue for XFeat", "xfeat-lighterglue.pt", f"{_XFEAT}/xfeat-lighterglue.pt"),
    "aliked": Checkpoint(
        "LightGlue for ALIKED", "aliked_lightglue_v0-1_arxiv-pth", f"{_LIGHTGLUE}/aliked_lightglue.pth"
    ),
    "disk": Checkpoint("LightGlue for DISK", "disk_lightglue_v0-1_arxiv-pth", f"{_LIGHTGLUE}/disk_lightglue.pth"),
}
DETECTORS: Mapping[str, tuple[Checkpoint, ...]] = {
    "dog": (),
    "harris": (),
    "keynet": (KEYNET, AFFNET, ORINET),
    "xfeat": (XFEAT,),
    "aliked": (ALIKED,),
    "disk": (DISK,),
    "dedode": (DEDODE_DETECTOR, DEDODE_DESCRIPTOR),
}
"""What each detector needs; the networks describe as well."""
DESCRIPTORS: Mapping[str, tuple[Checkpoint, ...]] = {"sift": (), "hardnet": (HARDNET,)}
