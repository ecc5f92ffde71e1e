"""The synthetic sequence: exact truth, reproducibility, disturbances."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.core.errors import ConfigError, InputError
from dualslam.lab.synthetic import SyntheticSequence, make_sequence, parse_events
from tests.seeds import first_of

SMALL = {"width": 160, "height": 120, "n_frames": 40}
SPOILT = (
    Corruption(kind=CorruptionKind.BLUR, start=2, length=2, strength=6.0),
    Corruption(kind=CorruptionKind.BLACKOUT, start=5, length=2),
    Corruption(kind=CorruptionKind.DROP, start=9, length=3),
    Corruption(kind=CorruptionKind.EXPOSURE, start=14, length=1, strength=2.0),
    Corruption(kind=CorruptionKind.WIPE, start=16, length=1),
    Corruption(kind=CorruptionKind.NOISE, start=18, length=1, strength=30.0),
    Corruption(kind=CorruptionKind.ROTATION, start=20, length=10, strength=50.0),
    Corruption(kind=CorruptionKind.SHUTTER, start=24, length=2, strength=1.0),
)


@pytest.fixture(scope="module", params=first_of(["circuit", "street", "room"]))  # the others are built alike
def clean(request: pytest.FixtureRequest) -> SyntheticSequence:
    return make_sequence(request.param, seed=3, **SMALL)


@pytest.fixture(scope="module")
def spoilt() -> SyntheticSequence:
    return make_sequence("room", seed=3, events=SPOILT, **SMALL)


@pytest.fixture(scope="module")
def unspoilt() -> SyntheticSequence:
    return make_sequence("room", seed=3, **SMALL)


def gradient_energy(image: np.ndarray) -> float:
    return float(np.square(np.diff(image.astype(np.float64), axis=1)).mean())


def pixels(sequence: SyntheticSequence) -> np.ndarray:
    """Return the centres of all pixels (N, 2) as (u, v)."""
    v, u = np.mgrid[: sequence.camera.height, : sequence.camera.width]
    return np.stack([u.ravel(), v.ravel()], 1).astype(np.float64)


def project(sequence: SyntheticSequence, index: int, xyz_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) and depths (N,) of world points, independently of the renderer."""
    T_cam_world = np.linalg.inv(sequence.ground_truth_T_world_cam[index])
    p = xyz_world @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    uvw = p @ sequence.camera.K.T
    return uvw[:, :2] / uvw[:, 2:], p[:, 2]


@pytest.mark.parametrize(("first", "second"), [(0, 2), (20, 23), (30, 27)])
def test_surface_points_look_the_same_from_two_poses(clean: SyntheticSequence, first: int, second: int) -> None:
    uv = pixels(clean)
    xyz_world = clean.points_world(first, uv)
    seen = np.isfinite(xyz_world[:, 0])
    uv_there, z_there = project(clean, second, xyz_world[seen])
    size = np.array([clean.camera.width, clean.camera.height])
    inside = ((uv_there > 1) & (uv_there < size - 2)).all(1) & (z_there > 0)
    map_uv = uv_there[inside].astype(np.float32)[None]
    depth_there = cv2.remap(clean.depth(second), map_uv[..., 0], map_uv[..., 1], cv2.INTER_NEAREST)[0]
    not_hidden = np.abs(depth_there / z_there[inside] - 1) < 0.02
    assert not_hidden.sum() > 0.25 * len(uv)  # the street's sky and what leaves the image are not seen twice

    image_a, image_b = (clean.frame(i).image.astype(np.float32) for i in (first, second))
    warped = cv2.remap(image_b, map_uv[..., 0], map_uv[..., 1], cv2.INTER_LINEAR)[0]
    original = image_a.ravel()[np.flatnonzero(seen)[inside]]
    # The noise alone, of two images, gives about 2; wrong poses give 20 and more (see the next assertion).
    error = np.abs(warped - original)[not_hidden]
    assert np.median(error) < 4.5
    assert error.mean() < 8.0
    shifted = np.abs(np.roll(warped, 4) - original)[not_hidden]
    assert error.mean() < 0.6 * shifted.mean()


def test_depth_is_that_of_the_nearest_surface_along_the_ray(clean: SyntheticSequence) -> None:
    """The renderer's scan against a plain intersection of each ray with each (opaque) rectangle."""
    renderer = clean._renderer
    depth = clean.depth(7)
    T_world_cam = clean.ground_truth_T_world_cam[7]
    solid = np.flatnonzero(~renderer._infinite & ~renderer._cutout)
    cut = np.flatnonzero(renderer._cutout & ~renderer._infinite)
    uv = np.random.default_rng(0).integers(0, (clean.camera.width, clean.camera.height), (300, 2))
    rays = np.c_[uv, np.ones(len(uv))] @ np.linalg.inv(clean.camera.K).T @ T_world_cam[:3, :3].T

    def nearest(chosen: np.ndarray) -> np.ndarray:
        M = np.stack([renderer._side_s[chosen], renderer._side_t[chosen], np.zeros((len(chosen), 3))], 2)
        M = np.broadcast_to(M, (len(rays), *M.shape)).copy()
        M[..., 2] = -rays[:, None]
        s_t_z = np.linalg.solve(M, (T_world_cam[:3, 3] - renderer._origin[chosen])[None, ..., None])[..., 0]
        normal = np.cross(renderer._side_s[chosen], renderer._side_t[chosen])
        front = (normal @ rays.T).T > 0
        hit = ((s_t_z[..., :2] >= 0) & (s_t_z[..., :2] <= 1)).all(2) & (s_t_z[..., 2] > 0.06)
        hit &= front | renderer._two_sided[chosen]
        return np.where(hit, s_t_z[..., 2], np.inf).min(1)

    expected = nearest(solid)
    found = depth[uv[:, 1], uv[:, 0]].astype(np.float64)
    if len(cut):  # leaves and fences hide some
        through = nearest(cut)
        expected = np.where(through < expected, np.minimum(expected, np.maximum(found, through)), expected)
    same = np.isclose(found, expected, rtol=1e-4) | (np.isinf(found) & np.isinf(expected))
    # Not drawn: what is smaller than a pixel.
    assert same.mean() > 0.985


def test_the_same_seed_gives_the_same_images_in_any_order_also_of_forgotten_textures(clean: SyntheticSequence) -> None:
    again = make_sequence(clean.parameters["scene"], seed=3, **SMALL)
    again._renderer._textures._max_bytes = 20_000
    for i in (30, 4, 17, 0):
        assert np.array_equal(again.frame(i).image, clean.frame(i).image)
    assert len(again._renderer._textures._textures) < len(clean._renderer._textures._textures)
    assert np.array_equal(again.ground_truth_T_world_cam, clean.ground_truth_T_world_cam)
    other = make_sequence(clean.parameters["scene"], seed=4, **SMALL)
    assert not np.array_equal(other.frame(0).image, clean.frame(0).image)


def test_iteration_equals_random_access_and_skips_dropped_frames(spoilt: SyntheticSequence) -> None:
    frames = list(spoilt)
    assert [f.index for f in frames] == [i for i in range(40) if i not in (9, 10, 11)]
    assert len(spoilt) == 37
    assert spoilt.ground_truth_T_world_cam.shape == (40, 4, 4)
    for i in (24, 5, 0):
        frame = next(f for f in frames if f.index == i)
        assert np.array_equal(frame.image, spoilt.frame(i).image)
        assert frame.timestamp_s == pytest.approx(i / spoilt.rate_hz)
    with pytest.raises(InputError, match="dropped"):
        spoilt.frame(10)
    with pytest.raises(InputError, match="no frame 40"):
        spoilt.frame(40)


def test_poses_are_smooth_rigid_motions(clean: SyntheticSequence) -> None:
    T = clean.ground_truth_T_world_cam
    assert np.allclose(T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-12)
    steps = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    assert steps.max() < (0.05 if clean.parameters["scene"] == "room" else 1.2)
    turns = np.degrees(np.arccos(np.clip((np.einsum("nij,nij->n", T[1:, :3, :3], T[:-1, :3, :3]) - 1) / 2, -1, 1)))
    assert turns.max() < 4.0


def test_events_do_what_they_say(spoilt: SyntheticSequence, unspoilt: SyntheticSequence) -> None:
    def images(i: int) -> tuple[np.ndarray, np.ndarray]:
        return spoilt.frame(i).image, unspoilt.frame(i).image

    untouched = images(0)
    assert np.array_equal(*untouched)
    blurred, sharp = images(2)
    assert gradient_energy(blurred) < 0.5 * gradient_energy(sharp)
    assert images(5)[0].mean() < 3
    bright, normal = images(14)
    assert bright.mean() > 1.4 * normal.mean()
    wiped, normal = images(16)
    assert gradient_energy(wiped) < 0.2 * gradient_energy(normal)
    assert abs(wiped.mean() - normal.mean()) < 10
    noisy, normal = images(18)
    assert np.std(noisy.astype(float) - normal) == pytest.approx(30, rel=0.25)
    smeared, sharp = images(24)[0], make_sequence("room", seed=3, events=SPOILT[:-1], **SMALL).frame(24).image
    assert gradient_energy(smeared) < 0.8 * gradient_energy(sharp)


def test_rotation_events_turn_the_camera_on_the_spot_and_back(
    spoilt: SyntheticSequence, unspoilt: SyntheticSequence
) -> None:
    A, B = spoilt.ground_truth_T_world_cam, unspoilt.ground_truth_T_world_cam
    assert np.array_equal(A[:, :3, 3], B[:, :3, 3])
    angle_deg = np.degrees(np.arccos(np.clip((np.einsum("nij,nij->n", A[:, :3, :3], B[:, :3, :3]) - 1) / 2, -1, 1)))
    assert (angle_deg[:20] < 1e-4).all()
    assert (angle_deg[30:] < 1e-4).all()
    assert 45 < angle_deg.max() <= 50.001


def test_scripts_are_read_from_plain_mappings() -> None:
    script = parse_events(
        [{"kind": "blackout", "start": 3, "length": 2}, Corruption(kind=CorruptionKind.BLUR, start=0, length=1)]
    )
    assert script[0] == Corruption(kind=CorruptionKind.BLACKOUT, start=3, length=2)
    for wrong, message in (
        ({"kind": "fog", "start": 0, "length": 1}, "kind must be 'wipe'"),
        ({"kind": "blur", "start": -1, "length": 1}, "start must be greater"),
        ({"kind": "blur", "start": 0, "length": 0}, "length must be greater"),
        ({"kind": "blur", "start": 0, "length": 1, "strength": -2}, "strength of blur is -2"),
        ({"kind": "blur", "start": 0, "length": 1, "strength": "much"}, "strength must be a number"),
        ({"kind": "rotation", "start": 0}, "needs a length"),
        ({"kind": "freeze", "start": 0}, "freeze needs images that are there"),
        ({"kind": "blur", "start": 0, "length": 1, "size": 3}, "unknown field size"),
        ("blur", "must be a mapping"),
    ):
        with pytest.raises(ConfigError, match=message):
            parse_events([wrong])  # type: ignore[list-item]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scene": "moon"}, "scene 'moon'"),
        ({"n_frames": 0}, "n_frames is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"width": 12.5}, "width is 12.5"),
        ({"rate_hz": 0.0}, "rate_hz is 0"),
        ({"supersampling": 9.0}, "supersampling is 9"),
    ],
)
def test_wrong_parameters_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_sequence(**wrong)  # type: ignore[arg-type]


def test_noise_is_new_in_each_frame() -> None:
    """Else a covered lens shows a world of its own: a plane of noise, which features match and a map is made of."""
    sequence = make_sequence(
        "street", seed=3, events=[Corruption(kind=CorruptionKind.BLACKOUT, start=0, length=3)], **SMALL
    )
    spectra = []
    for index in range(3):
        noise = sequence.frame(index).image.astype(np.float64)
        noise -= noise.mean(axis=0)
        spectra.append(np.fft.rfft2(noise / noise.std()))
    for a, b in ((0, 1), (1, 2), (0, 2)):
        # At any shift: the largest of N values of variance 1 / N is expected at about sqrt(2 ln N / N).
        correlation = np.fft.irfft2(spectra[a] * spectra[b].conj()) / (160 * 120)
        assert np.abs(correlation).max() < 6 / np.sqrt(160 * 120)
