"""Every front end keeps the protocol, one of another package too, and the suite notices where one does not."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.core.config.settings import FrontendConfig
from dualslam.core.errors import ConfigError
from dualslam.core.types import Features, Matches
from dualslam.frontends import registry
from dualslam.frontends.conformance import CHECKS, NotConforming, Subject, check_frontend
from dualslam.frontends.conformance.scene import PrintedPlane, tilted, transfer
from dualslam.frontends.features.gms import GmsFrontend
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.features.sift import SiftFrontend

EXAMPLE = Path(__file__).with_name("example_package")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which pip installed the example package."""
    source, site = tmp_path_factory.mktemp("source") / "package", tmp_path_factory.mktemp("site")
    shutil.copytree(EXAMPLE, source)
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "--no-index", "--target", str(site), str(source)], check=True)
    return site


@pytest.fixture
def with_example(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(installed))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize(
    ("factory", "options"),
    [
        (OrbFrontend, {}),
        (SiftFrontend, {}),
        (GmsFrontend, {}),
        (GmsFrontend, {"rotation": True, "zoom": True}),
    ],
    ids=["orb", "sift", "gms", "gms of any turn"],
)
def test_ours_conform(factory: Any, options: Mapping[str, Any], check: Callable[[Subject], None]) -> None:
    check(Subject(factory, options))


@pytest.mark.usefixtures("with_example")
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_one_of_another_package_conforms(check: Callable[[Subject], None]) -> None:
    frontend = registry.create_frontend(FrontendConfig(name="patches"))
    check(Subject(type(frontend)))  # type: ignore[arg-type]


@pytest.mark.usefixtures("with_example")
def test_it_is_known_by_its_name_and_refuses_unknown_options() -> None:
    assert registry.FRONTENDS.known == sorted([*registry.BUILT_IN, "patches"])
    config = FrontendConfig(name="patches", n_features=70, options={"quality": 0.1})
    assert registry.create_frontend(config).n_features == 70  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"frontend\.options\.qualty.*quality"):
        registry.create_frontend(FrontendConfig(name="patches", options={"qualty": 0.1}))


def test_it_is_gone_without_its_package() -> None:
    with pytest.raises(ConfigError, match=r"'patches'; known: auto, gms, "):
        registry.create_frontend(FrontendConfig(name="patches"))


# --- the scene


def test_scene_is_where_it_says() -> None:
    centres = np.array([[100.25, 80.5], [211.75, 90.0], [330.4, 250.3]])
    scene = PrintedPlane.of_discs(centres, 6.0, (480, 360))
    H = tilted(scene.size_px)
    for view, expected in ((None, centres), (H, transfer(H, centres))):
        image = scene.photograph(view, noise=0.0).astype(np.float64) - 60.0
        for centre in expected:
            u, v = np.meshgrid(np.arange(480.0), np.arange(360.0))
            weight = image * (np.hypot(u - centre[0], v - centre[1]) < 12)
            found = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
            np.testing.assert_allclose(found, centre, atol=0.03)


# --- front ends with one fault each


class Faulty(OrbFrontend):
    """ORB, and what a fault does to its features and matches."""

    fault: Callable[[Features], Features] = staticmethod(lambda features: features)  # type: ignore[assignment]

    def extract(self, image: NDArray[np.uint8]) -> Features:
        return type(self).fault(super().extract(image))


def moved(features: Features, by_px: Any) -> Features:
    uv = np.clip(features.uv_px + by_px, 0, (479, 359))
    return replace(features, uv_px=uv, uv_rect_px=uv)


FAULTS: dict[str, tuple[Callable[[Features], Features], str]] = {
    "half a pixel off": (lambda f: moved(f, 0.5), "check_pixel_centres_by_mirroring"),
    "half a pixel off at the discs": (lambda f: moved(f, 0.5), "check_pixel_centres_by_discs"),
    "centres of levels confused": (
        lambda f: moved(f, (f.scale[:, None] - 1) / 2),
        "check_pixel_centres_by_mirroring",
    ),
    "single precision": (lambda f: replace(f, sigma_px=f.sigma_px.astype(np.float32)), "check_shapes_and_types"),
    "rectified by itself": (lambda f: replace(f, uv_rect_px=f.uv_px + 1), "check_shapes_and_types"),
    "scale in pixels": (lambda f: replace(f, scale=31 * f.scale), "check_shapes_and_types"),
    "degrees": (lambda f: replace(f, angle_rad=np.degrees(f.angle_rad)), "check_shapes_and_types"),
    "angles the other way": (lambda f: replace(f, angle_rad=-f.angle_rad), "check_turns_as_declared"),
    "no noise": (lambda f: replace(f, sigma_px=f.sigma_px / 10), "check_noise_model"),
    "too much noise": (lambda f: replace(f, sigma_px=f.sigma_px * 5), "check_noise_model"),
    "noise blind to scale": (lambda f: replace(f, sigma_px=0.1 + 0 * f.sigma_px), "check_noise_model"),
    "all of one octave": (lambda f: replace(f, octave=0 * f.octave, scale=1 + 0 * f.scale), "check_zooms_as_declared"),
    "descriptors of the neighbour": (
        lambda f: replace(f, descriptors=np.roll(f.descriptors, 1, axis=0)),
        "check_guided_search",
    ),
    "a corner of the image": (lambda f: f.take((f.uv_px < (300, 200)).all(axis=1)), "check_number_and_spread"),
    "none": (lambda f: f.take(np.zeros(len(f), np.bool_)), "check_number_and_spread"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_fault_in_the_features_is_noticed(name: str) -> None:
    fault, check = FAULTS[name]
    faulty = type("Faulty", (Faulty,), {"fault": staticmethod(fault)})
    with pytest.raises(NotConforming):
        next(each for each in CHECKS if each.__name__ == check)(Subject(faulty))


class Stateful(OrbFrontend):
    """Looks at every second image in another way."""

    n_seen = 0

    def extract(self, image: NDArray[np.uint8]) -> Features:
        self.n_seen += 1
        features = super().extract(image)
        return features.take(np.arange(len(features) - self.n_seen % 2))


class Rolling(OrbFrontend):
    """Draws from the global generator."""

    def extract(self, image: NDArray[np.uint8]) -> Features:
        np.random.random()  # noqa: NPY002
        return super().extract(image)


class Greedy(OrbFrontend):
    """Lets two features share one."""

    def match_wide(self, a: Features, b: Features) -> Matches:
        if len(a) == 0 or len(b) == 0:
            return super().match_wide(a, b)
        index = np.stack([np.arange(len(a)), self.nearest(a, b)], axis=1)
        return Matches(index, self.distance(a.descriptors, b.descriptors[index[:, 1]]))


class Stumbling(OrbFrontend):
    """Lets OpenCV raise at images that are tiny."""

    def extract(self, image: NDArray[np.uint8]) -> Features:
        cv2.resize(image, (image.shape[1] // 9, image.shape[0] // 9))
        return super().extract(image)


class OneSided(OrbFrontend):
    """Matches half of the first set's features."""

    def match_wide(self, a: Features, b: Features) -> Matches:
        return super().match_wide(a.take(np.arange(len(a) // 2)), b)


class Boastful(OrbFrontend):
    """Declares a zoom that it does not bear."""

    max_zoom = 4.0


class Strict(OrbFrontend):
    """Rejects what its descriptors can tell."""

    def __init__(self, n_features: int = 1500, options: Any = None) -> None:
        super().__init__(n_features, options)
        self.max_distance = self.max_distance_strict = 10.0


class Lenient(Strict):
    """Takes everything for the same point."""

    def __init__(self, n_features: int = 1500, options: Any = None) -> None:
        super().__init__(n_features, options)
        self.max_distance = self.max_distance_strict = 150.0


class Careless(OrbFrontend):
    """Takes any option."""

    @classmethod
    def from_options(cls, n_features: int, options: Mapping[str, Any]) -> OrbFrontend:
        return cls(n_features)


@pytest.mark.parametrize(
    ("factory", "check"),
    [
        (Stateful, "check_same_image_same_features"),
        (Rolling, "check_no_global_state"),
        (Greedy, "check_matches_are_one_to_one"),
        (Greedy, "check_other_scenes_do_not_match"),
        (OneSided, "check_matching_is_symmetric"),
        (Boastful, "check_zooms_as_declared"),
        (Strict, "check_distance_limits"),
        (Lenient, "check_distance_limits"),
        (Careless, "check_wrong_option_is_named"),
    ],
)
def test_fault_of_behaviour_is_noticed(factory: Any, check: str) -> None:
    with pytest.raises(NotConforming):
        next(each for each in CHECKS if each.__name__ == check)(Subject(factory))


def test_report_names_every_check_that_failed() -> None:
    with pytest.raises(NotConforming) as report:
        check_frontend(Greedy)
    lines = str(report.value).splitlines()
    assert lines[0].endswith("checks failed")
    assert {"check_matches_are_one_to_one", "check_other_scenes_do_not_match"} <= {line.split(":")[0] for line in lines}
    check_frontend(OrbFrontend)


def test_report_goes_on_where_a_front_end_raises() -> None:
    with pytest.raises(NotConforming) as report:
        check_frontend(Stumbling)
    lines = str(report.value).splitlines()
    assert any(line.startswith("check_flat_and_tiny_images: cv2.error: OpenCV") for line in lines)
    assert len(lines) < len(CHECKS), "the others are made all the same"
