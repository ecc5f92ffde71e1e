"""Settings that older versions had, and what replaced each: the error message for a file that still has one."""

from __future__ import annotations

RENAMED = {
    "max_leap_frames": "max_gap_frames",
    "resume_after": "relocalise_after",
    "seam_keyframes": "overlap_keyframes",
    "walk": "tracking",
}
"""Fields that are called otherwise now."""

FOLLOWS = {
    "initialiser.min_matches": "initialiser.min_points",
    "linking.max_scale_sigma": "linking.wrong_scale",
    "linking.max_live_scale_sigma": "linking.wrong_scale",
    "tracking.max_gap_scale_sigma": "linking.wrong_scale",
    "recovery.max_gap_scale_sigma": "linking.wrong_scale",
    "tracking.max_leap_scale_sigma": "linking.wrong_scale",
    "recovery.max_leap_scale_sigma": "linking.wrong_scale",
    "linking.max_rotation_sigma_deg": "linking.wrong_rotation_deg",
    "linking.max_live_rotation_deg": "linking.wrong_rotation_deg",
    "linking.max_position_sigma": "linking.wrong_position",
}
"""Limits that follow from another one."""

CONSTANTS = {
    "calibration.far_sigma_ratio": "dualslam.backend.self_calibration.MAX_SIGMA",
    "calibration.far_sigmas": "dualslam.backend.self_calibration.FAR_SIGMAS",
    "calibration.growth": "dualslam.calibration.lens.GROWTH",
    "calibration.k1_sigma": "dualslam.backend.self_calibration.K1_SIGMA",
    "calibration.k2_sigma": "dualslam.backend.self_calibration.K2_SIGMA",
    "calibration.min_distance2": "dualslam.backend.self_calibration.MIN_DISTANCE2",
    "calibration.principal_point_sigma": "dualslam.backend.self_calibration.PRINCIPAL_POINT_SIGMA",
    "calibration.update_sigma_ratio": "dualslam.calibration.lens.UPDATE_SIGMA_RATIO",
    "camera.readout_evidence": "dualslam.frontends.tracking.pair_readout.READOUT_EVIDENCE",
    "fusion.max_shift_chi2": "dualslam.recovery.overlap_refinement.MAX_SHIFT_CHI2",
    "graph.enter_sigmas": "dualslam.backend.factor_index.ENTER_SIGMAS",
    "graph.insert_sigmas": "dualslam.backend.factor_index.INSERT_SIGMAS",
    "graph.least_noise": "dualslam.backend.noise.LEAST_NOISE",
    "graph.max_depth_sigma": "dualslam.backend.factor_index.MAX_DEPTH_SIGMA",
    "graph.merge_iterations": "dualslam.backend.submap_graph.MERGE_ITERATIONS",
    "graph.min_ties": "dualslam.backend.factor_index.MIN_TIES",
    "graph.min_views": "dualslam.backend.factor_index.MIN_VIEWS",
    "graph.outlier_chi2": "dualslam.backend.noise.OUTLIER_CHI2",
    "graph.read_all_every": "dualslam.backend.submap_graph.READ_ALL_EVERY",
    "graph.read_window": "dualslam.backend.reading.READ_WINDOW",
    "graph.rebuild_inlier_ratio": "dualslam.frontends.tracking.visual.REBUILD_INLIER_RATIO",
    "graph.rebuild_iterations": "dualslam.backend.submap_graph.REBUILD_ITERATIONS",
    "graph.rebuild_spacing": "dualslam.frontends.tracking.visual.REBUILD_SPACING",
    "graph.young_keyframes": "dualslam.backend.factor_index.YOUNG_KEYFRAMES",
    "health.jump_chi2": "dualslam.health.JUMP_CHI2",
    "health.level_frames": "dualslam.health.LEVEL_FRAMES",
    "health.majority": "dualslam.health.MAJORITY",
    "health.max_keyframe_chi2": "dualslam.health.MAX_KEYFRAME_CHI2",
    "health.sign_sigmas": "dualslam.health.SIGN_SIGMAS",
    "health.sign_weight": "dualslam.health.SIGN_WEIGHT",
    "initialiser.homography_ratio": "dualslam.frontends.tracking.two_view_hypotheses.PLANAR_SHARE",
    "initialiser.max_chi2": "dualslam.frontends.tracking.initialiser.MAX_CHI2",
    "initialiser.max_views": "dualslam.frontends.tracking.initialiser.MAX_VIEWS",
    "initialiser.min_support": "dualslam.frontends.tracking.initialiser.MIN_SUPPORT",
    "keyframes.min_parallax_deg": "dualslam.frontends.tracking.keyframing.MIN_PARALLAX_DEG",
    "linking.descriptor_radius_px": "dualslam.recovery.linking.gates.DESCRIPTOR_RADIUS_PX",
    "linking.gate_sigmas": "dualslam.recovery.linking.gates.GATE_SIGMAS",
    "linking.look_back": "dualslam.recovery.linking.gates.LOOK_BACK",
    "linking.max_hypotheses": "dualslam.recovery.linking.gates.MAX_HYPOTHESES",
    "linking.max_misfits": "dualslam.recovery.linking.gates.MAX_MISFITS",
    "linking.max_scale": "dualslam.recovery.linking.gates.MAX_SCALE",
    "linking.min_depth_spread": "dualslam.recovery.linking.gates.MIN_DEPTH_SPREAD",
    "linking.min_image_spread": "dualslam.recovery.linking.gates.MIN_IMAGE_SPREAD",
    "linking.min_majority": "dualslam.recovery.linking.gates.MIN_MAJORITY",
    "linking.min_pairs_per_keyframe": "dualslam.recovery.linking.gates.MIN_PAIRS_PER_KEYFRAME",
    "linking.min_ties": "dualslam.recovery.linking.gates.MIN_TIES",
    "linking.pair_chi2": "dualslam.recovery.linking.gates.PAIR_CHI2",
    "linking.pixel_chi2": "dualslam.recovery.linking.gates.PIXEL_CHI2",
    "linking.strain_chi2": "dualslam.recovery.linking.gates.STRAIN_CHI2",
    "linking.tie_window": "dualslam.recovery.linking.gates.TIE_WINDOW",
    "mapping.min_found_ratio": "dualslam.frontends.tracking.mapper.MIN_FOUND_RATIO",
    "mapping.min_observations": "dualslam.frontends.tracking.mapper.MIN_OBSERVATIONS",
    "mapping.reprojection_chi2": "dualslam.core.chi_square.CHI2_95",
    "mapping.triangulate_against": "dualslam.frontends.tracking.mapper.TRIANGULATE_AGAINST",
    "recovery.max_shared_keyframes": "dualslam.recovery.relinker.MAX_SHARED_KEYFRAMES",
    "recovery.min_shared_keyframes": "dualslam.recovery.relinker.MIN_SHARED_KEYFRAMES",
    "tracking.local_keyframes": "dualslam.frontends.tracking.tracker.LOCAL_KEYFRAMES",
    "tracking.local_radius_px": "dualslam.frontends.tracking.tracker.LOCAL_RADIUS_PX",
    "tracking.wide_keyframes": "dualslam.frontends.tracking.tracker.WIDE_KEYFRAMES",
}
"""Constants now, beside the algorithm that they belong to."""


def what_became_of(path: str) -> str | None:
    """Return in one sentence what has become of a setting (``section.field``); None where it never was one."""
    if path in FOLLOWS:
        return f"{path} is no setting any more: it follows from {FOLLOWS[path]}"
    if path in CONSTANTS:
        return f"{path} is no setting any more but a constant, {CONSTANTS[path]}; remove it from the configuration"
    if path == "tracking.max_lost_frames":
        return f"{path} is no setting any more: tracking.max_lost_s says it in seconds"
    if path == "graph.extra_iterations":
        return f"{path} is no setting any more: a keyframe has two updates; remove it from the configuration"
    return None
