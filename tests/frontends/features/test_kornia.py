"""The kornia front end without weights: where its features lie, how they match, and what stays outside it."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dualslam.core.config.settings import FrontendConfig
from dualslam.core.errors import ConfigError, InputError, how_to_install
from dualslam.core.types import Features
from dualslam.frontends.conformance import CHECKS, Subject
from dualslam.frontends.features.kornia.frontend import KorniaFrontend, inference
from dualslam.frontends.features.kornia.options import KorniaOptions
from dualslam.frontends.features.matching import FeatureGrid, match_projected
from dualslam.frontends.registry import create_frontend
from tests.frontends.conftest import textured
from tests.frontends.features.test_orb import same, warped

Image = NDArray[np.uint8]
CPU = torch.device("cpu")
on_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")


def on_cpu(n_features: int = 500, **options: object) -> KorniaFrontend:
    return KorniaFrontend(n_features, KorniaOptions.model_validate({"device": "cpu", **options}))


@pytest.fixture(scope="module")
def features(image: Image) -> Features:
    return on_cpu().extract(image)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("options", [{}, {"detector": "harris", "matcher": "smnn"}], ids=["dog", "harris"])
def test_conforms(options: dict[str, str], check: Callable[[Subject], None]) -> None:
    check(Subject(KorniaFrontend, {"device": "cpu", **options}))


def test_is_found_by_its_name_and_takes_its_options() -> None:
    options = {"detector": "harris", "matcher": "smnn", "n_octaves": 4, "device": "cpu", "max_distance": 0.7}
    frontend = create_frontend(FrontendConfig(name="kornia", n_features=77, options=options))
    assert isinstance(frontend, KorniaFrontend)
    assert (frontend.n_features, frontend.n_octaves, frontend.max_distance) == (77, 4, 0.7)
    assert 0 < frontend.max_distance_strict < 0.7


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"detector": "superpoint"}, r"frontend\.options\.detector.*'xfeat'"),
        ({"detektor": "dog"}, r"frontend\.options\.detektor.*its options: detector"),
        ({"descriptor": "sift"}, r"frontend\.options\.descriptor.*its options: detector"),
        ({"matcher": "lightglue"}, "'lightglue' goes with the detectors xfeat, aliked, disk"),
    ],
)
def test_wrong_options_are_named(options: dict[str, object], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        create_frontend(FrontendConfig(name="kornia", options=options))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_without_a_device_is_a_config_error_and_auto_takes_the_cpu(image: Image, features: Features) -> None:
    with pytest.raises(ConfigError, match=r"frontend\.options\.device: torch .* sees no CUDA device"):
        KorniaFrontend(100, KorniaOptions(device="cuda"))
    assert same(KorniaFrontend(500).extract(image), features)


@on_cuda
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_conforms_on_cuda(check: Callable[[Subject], None]) -> None:
    check(Subject(KorniaFrontend, {"device": "cuda"}))


@on_cuda
@pytest.mark.parametrize("detector", ["dog", "harris"])
def test_cuda_finds_the_same_each_time_and_what_the_cpu_finds(image: Image, detector: str) -> None:
    cuda, cpu = (KorniaFrontend(800, KorniaOptions(detector=detector, device=name)) for name in ("cuda", "cpu"))
    a = cuda.extract(image)
    assert all(same(cuda.extract(image), a) for _ in range(5))
    b = cpu.extract(image)
    apart = np.hypot(*(a.uv_px[:, None] - b.uv_px).transpose(2, 0, 1))
    nearest = np.argmin(np.where(a.octave[:, None] == b.octave, apart, np.inf), axis=1)
    both = apart[np.arange(len(a)), nearest] < 0.05
    assert both.mean() > 0.97
    distance = cpu.distance(a.descriptors[both], b.descriptors[nearest[both]])
    assert np.percentile(distance, 99) < 0.05  # a tenth of what descriptors of a point in two images may differ
    other = warped(image, 1.0, 5.0)[0]
    of_cuda, of_cpu = (len(each.match_wide(each.extract(image), each.extract(other))) for each in (cuda, cpu))
    assert abs(of_cuda - of_cpu) < 0.05 * of_cpu


@on_cuda
def test_settings_of_cuda_are_put_back() -> None:
    before = torch.are_deterministic_algorithms_enabled(), torch.backends.cudnn.allow_tf32
    with inference(torch.device("cuda")):
        assert torch.are_deterministic_algorithms_enabled()
    assert (torch.are_deterministic_algorithms_enabled(), torch.backends.cudnn.allow_tf32) == before


def test_shapes_types_and_noise(features: Features) -> None:
    assert len(features) == 500
    assert features.descriptors.shape == (500, 128)
    assert features.descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-5)
    assert features.uv_px.dtype == features.sigma_px.dtype == features.angle_rad.dtype == np.float64
    assert features.octave.dtype == np.int64
    assert (np.diff(features.octave) >= 0).all()
    assert set(features.octave.tolist()) == set(range(8))
    np.testing.assert_allclose(features.scale, 1.2**features.octave)
    assert set(np.round(features.sigma_px / features.scale, 9)) == {0.5, 0.75}
    np.testing.assert_array_equal(features.uv_rect_px, features.uv_px)
    assert ((features.uv_px >= 0) & (features.uv_px <= (639, 479))).all()


def test_keypoints_cover_the_image(features: Features) -> None:
    counts = np.histogram2d(*features.uv_px.T[::-1], bins=(3, 4), range=((0, 480), (0, 640)))[0]
    assert counts.min() >= 500 / 12 / 4


@pytest.mark.parametrize("detector", ["dog", "harris"])
@pytest.mark.parametrize("matcher", ["smnn", "adalam"])
@pytest.mark.parametrize(("scale", "degrees"), [(1.0, 0.0), (1.0, 40.0), (1 / 1.2**2, 10.0)])
def test_features_come_back_in_a_turned_and_scaled_image(
    image: Image, detector: str, matcher: str, scale: float, degrees: float
) -> None:
    frontend = on_cpu(800, detector=detector, matcher=matcher)
    other, affine = warped(image, scale, degrees)
    a, b = frontend.extract(image), frontend.extract(other)
    matches = frontend.match_wide(a, b)
    first, second = matches.index.T
    error = b.uv_px[second] - (a.uv_px[first] @ affine[:, :2].T + affine[:, 2])
    right = np.hypot(*error.T) < 3 * a.scale[first]
    assert len(matches) >= 100
    assert right.mean() >= 0.95
    assert len(set(first.tolist())) == len(set(second.tolist())) == len(matches)
    # Half a pixel of a level too much or too little would show in the mean, noise in the median.
    assert np.abs(np.median(error[right] / b.scale[second[right], None], axis=0)).max() < 0.1
    assert np.median(np.abs(error[right]) / b.scale[second[right], None]) < 0.35
    turn = np.angle(np.exp(1j * (b.angle_rad[second] - a.angle_rad[first] + np.radians(degrees))))
    assert np.abs(np.median(turn[right])) < np.radians(3)
    octaves = a.octave[first[right]] - b.octave[second[right]]
    assert np.abs(np.median(octaves) + np.log(scale) / np.log(1.2)) <= 0.5


def test_noise_model_covers_the_errors(image: Image) -> None:
    frontend = on_cpu(800)
    other, affine = warped(image, 0.97, 4.0)
    a, b = frontend.extract(image), frontend.extract(other)
    first, second = frontend.match_wide(a, b).index.T
    error = b.uv_px[second] - (a.uv_px[first] @ affine[:, :2].T + affine[:, 2])
    sigma = np.hypot(a.sigma_px[first], b.sigma_px[second])
    whitened = np.abs(error / sigma[:, None])
    # Its numbers come from real images, this one has no noise: neither too tight nor made of cotton wool.
    assert 0.5 < np.percentile(whitened, 95) < 1.96


def test_same_image_gives_same_features_and_matches_whatever_the_threads(image: Image, features: Features) -> None:
    other = on_cpu().extract(warped(image, 1.0, 5.0)[0])
    before = torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            frontend = on_cpu()
            assert same(frontend.extract(image), features)
            assert torch.get_num_threads() == threads
            matches = frontend.match_wide(features, other)
            again = frontend.match_wide(features, other)
            np.testing.assert_array_equal(matches.index, again.index)
    finally:
        torch.set_num_threads(before)


def test_threads_are_put_back_after_an_error() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        with inference(CPU):
            assert torch.get_num_threads() == 1
        with pytest.raises(ZeroDivisionError), inference(CPU):
            1 / 0  # noqa: B018
        assert torch.get_num_threads() == 2
        assert not torch.is_inference_mode_enabled()
    finally:
        torch.set_num_threads(before)


def test_colour_is_seen_as_grey(image: Image, features: Features) -> None:
    assert same(on_cpu().extract(np.repeat(image[:, :, None], 3, axis=2)), features)


@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (32, 32), (33, 33), (34, 300), (64, 40)])
def test_tiny_images_are_no_error(shape: tuple[int, int]) -> None:
    features = on_cpu(detector="harris").extract(np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8))
    assert features.descriptors.shape == (len(features), 128)
    assert len(features.uv_px) == len(features.sigma_px) == len(features.octave) == len(features)


@pytest.mark.parametrize("detector", ["dog", "harris"])
def test_flat_images_and_gentle_slopes_have_no_features(detector: str) -> None:
    slope = np.repeat(np.arange(200, dtype=np.uint8)[None], 150, axis=0)
    for image in (np.zeros((150, 200), np.uint8), np.full((150, 200), 255, np.uint8), slope):
        features = on_cpu(detector=detector).extract(image)
        assert len(features) == 0
        assert features.descriptors.dtype == np.float32
        assert features.octave.dtype == np.int64


@pytest.mark.parametrize("bad", [np.zeros((4, 4)), np.zeros((4, 4, 4), np.uint8), np.zeros((0, 5), np.uint8)])
def test_what_is_no_image_is_an_input_error(bad: Image) -> None:
    with pytest.raises(InputError, match="uint8"):
        on_cpu().extract(bad)


def test_input_is_left_alone(image: Image, features: Features) -> None:
    copy, descriptors = image.copy(), features.descriptors.copy()
    frontend = on_cpu()
    frontend.match_wide(frontend.extract(copy), features)
    np.testing.assert_array_equal(copy, image)
    np.testing.assert_array_equal(descriptors, features.descriptors)


@pytest.mark.parametrize("matcher", ["smnn", "adalam"])
def test_matching_few_features(features: Features, matcher: str) -> None:
    frontend = on_cpu(matcher=matcher)
    for n, m in ((0, 0), (0, 9), (9, 0), (1, 9), (2, 2), (3, 500), (9, 9)):
        matches = frontend.match_wide(features.take(np.arange(n)), features.take(np.arange(m)))
        assert matches.index.shape == (len(matches), 2)
        assert (matches.index[:, 0] == matches.index[:, 1]).all()


def test_distance_is_that_of_the_vectors() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 40, 128)).astype(np.float32)
    np.testing.assert_allclose(on_cpu().distance(a, b), np.linalg.norm(a - b, axis=1), rtol=1e-5)
    np.testing.assert_array_equal(on_cpu().distance(a, b), on_cpu().distance(b, a))
    assert (on_cpu().distance(a, a) == 0).all()
    assert on_cpu().distance(a[:0], b[:0]).shape == (0,)


def test_guided_matching_goes_by_the_descriptors(image: Image, features: Features) -> None:
    frontend = on_cpu()
    other, affine = warped(image, 1.0, 0.0)
    b = frontend.extract(other)
    predicted = features.uv_px @ affine[:, :2].T + affine[:, 2] + 3.0
    matches = match_projected(
        frontend, FeatureGrid.build(b.uv_px), b, predicted, 12 * features.scale, features.descriptors,
        octave=features.octave, angle_rad=features.angle_rad,
    )  # fmt: skip
    error = b.uv_px[matches.index[:, 1]] - predicted[matches.index[:, 0]] + 3.0
    right = np.hypot(*error.T) < 3 * features.scale[matches.index[:, 0]]
    assert len(matches) >= 250
    assert right.mean() >= 0.97


def test_can_be_sent_to_another_process(image: Image, features: Features) -> None:
    sent = pickle.loads(pickle.dumps(on_cpu()))
    assert same(sent.extract(image), features)


def test_many_octaves_of_a_small_image() -> None:
    features = on_cpu(50, n_octaves=16, scale_factor=2.0).extract(textured(120, 200, seed=4))
    assert len(features) == 50
    assert features.octave.max() == 1


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


def test_the_core_never_imports_torch() -> None:
    code = (
        "import sys, dualslam, dualslam.build\n"
        "from dualslam.core.config.settings import FrontendConfig\n"
        "from dualslam.frontends.registry import create_frontend\n"
        "create_frontend(FrontendConfig())\n"
        "print([name for name in ('torch', 'kornia', 'dualslam.frontends.features.kornia') if name in sys.modules])"
    )
    assert run(code).strip() == "[]"


@pytest.mark.parametrize("missing", ["torch", "kornia.feature"])
def test_without_the_extra_the_error_says_what_to_install(missing: str) -> None:
    code = (
        f"import sys; sys.modules['{missing}'] = None\n"
        "from dualslam.core.config.settings import FrontendConfig\n"
        "from dualslam.core.errors import ConfigError\n"
        "from dualslam.frontends.registry import create_frontend\n"
        "try: create_frontend(FrontendConfig(name='kornia'))\n"
        "except ConfigError as error: print(error)"
    )
    assert how_to_install("kornia") in run(code)
