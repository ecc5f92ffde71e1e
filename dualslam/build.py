"""The composition root: the one place that knows front ends, back end and system, and puts them together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backend.local_ba import bundle_adjust_arrays
from backend.submap_graph import ISam2SubmapGraph
from dualslam.core.camera import Camera
from dualslam.core.config import Config
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Failure, FailureReason, Features, Frame, View
from dualslam.linking import DescriptorMatcher, estimate_link
from dualslam.system import Components, System
from frontends.initialiser import Initialiser
from frontends.registry import create_frontend
from frontends.visual import VisualFrontEnd


def build_system(config: Config, camera: Camera) -> System:
    """Build a system from its config.

    Parameters
    ----------
    config : Config
    camera : Camera
        Lens model and size of the images that `System.step` will be given.

    Returns
    -------
    System

    Raises
    ------
    ConfigError
        If the front end is not known or its options are wrong.
    """
    frontend = create_frontend(config.frontend)
    size_px = (camera.width, camera.height)
    matcher = DescriptorMatcher(frontend.distance, frontend.max_distance, config.linking.descriptor_radius_px)
    return System(
        Components(
            view_of=lambda frame: view_of(frame, frontend, camera, config.camera.model_sigma_px),
            new_starter=lambda: Initialiser(
                frontend, bundle_adjust_arrays, config.initialiser, camera.K, size_px, config.seed
            ),
            new_graph=lambda: ISam2SubmapGraph(config.graph),
            new_odometry=lambda submap, graph: VisualFrontEnd(frontend, config, submap, graph, size_px),
            link=lambda old, new, onset: estimate_link(
                old, new, config.linking, np.random.default_rng(config.seed), onset, matcher
            ),
            K=camera.K,
        ),
        config,
    )


def view_of(frame: Frame, frontend: Frontend, camera: Camera, model_sigma_px: float) -> View | Failure:
    """Find a frame's features and take the lens distortion out of them."""
    if frame.image is None:
        return Failure(FailureReason.UNREADABLE, frame.error)
    height, width = frame.image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        return Failure(
            FailureReason.UNREADABLE,
            f"frame {frame.index} is {width}x{height}, the calibration is for {camera.width}x{camera.height}",
        )
    return View(frame.index, frame.timestamp_s, rectify(frontend.extract(frame.image), camera, model_sigma_px))


def rectify(features: Features, camera: Camera, model_sigma_px: float) -> Features:
    """Move features to the camera's pinhole equivalent; those that it cannot hold are dropped."""
    uv_rect_px, magnification = camera.rectify(features.uv_px)
    # In steps of an eighth of an octave: the graph shares one noise model among all pixels of one sigma.
    sigma_px = 2.0 ** (np.rint(8.0 * np.log2(np.hypot(features.sigma_px, model_sigma_px) * magnification)) / 8.0)
    rectified = replace(features, uv_rect_px=uv_rect_px, sigma_px=sigma_px)
    inside = np.isfinite(uv_rect_px).all(axis=1) & np.isfinite(magnification)
    return rectified if inside.all() else rectified.take(inside)
