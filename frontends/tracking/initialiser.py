"""How a submap starts: two views with parallax, whose pose the frames between them prove (`start_proof.py`).

A wrong start costs more than a late one. It must pass three tests:

1. The two views determine the direction of translation to within a stated sigma.
2. No other pose explains them nearly as well.
3. The frames between them agree with the points by their own pixels. They had no part in the estimate.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, cycle

import numpy as np

from dualslam.core.bundle import BundleAdjuster
from dualslam.core.chi_square import CHI2_95
from dualslam.core.config.settings import InitialiserConfig
from dualslam.core.decisions import Gate
from dualslam.core.geometry import se3
from dualslam.core.geometry.triangulation import triangulate_two_view
from dualslam.core.interfaces import START_REACH, Frontend
from dualslam.core.noise_model import GATE_SIGMAS, PAIR_MATCHES, PROOF_VIEWS, START_POINTS, TINY
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, Matches, Start, View
from dualslam.frontends.features.motion_statistics import match_by_motion, nearest_search
from dualslam.frontends.tracking.start_proof import StartProof, ViewPair, direction_angle_deg, direction_sigma_deg
from dualslam.frontends.tracking.two_view_hypotheses import RelativePoses

MIN_PARALLAX_DEG = 1.0
"""Angle under which the two cameras must see half as many points as `START_POINTS`, after the rotation is taken out.
However many more are far away: on a road most are, and the near ones fix the motion."""
MAX_DIRECTION_SIGMA_DEG = 1.5
"""Largest standard deviation (from the bundle adjustment's Hessian) of the direction of translation: by the pixels'
sigmas, or less in proportion, down to two thirds, where residuals are smaller than 0.3 of these."""
PATIENCE_S, MAX_LENIENCE = 10.0, 4 / 3
"""Seconds without a start after which its direction may be known less well, and how many times less at most: no map
costs more then. For a camera that hardly leaves its place for 24 s (`tum_fr1_rpy`) the best pairs know it to 1.3 to 1.9
degrees. Some runs found none below 1.5, and ended without a map."""

LAGS = (2, 4, 8, 16, 32, 64)  # frames back that are tried as the first view
LATE_LAGS = (96, 128, 160, START_REACH)
"""Frames back that are tried, too, once there are so many. A camera that turns to and fro sees the same again from
somewhere else: with 3 to 7 degrees of parallax on `tum_fr1_rpy`, where nearer pairs have 1 to 2."""
MAX_PAIRS = 2  # tried with each view, in turn: what two views farther apart lack, the next two lack most often as well
NEAR = 0.5  # share of the points that a start needs at least which must be near: on a road these fix the motion
RUNNER_UP = 0.75  # a pose that explains less than this share of what the best one does is out of the question,
UNEXPLAINED_TIMES, UNEXPLAINED_MORE = 2, 20  # and so is one that leaves more than twice as many, and a layer's worth
SAME_DEG = 10.0  # directions of translation that far apart are two answers
DIRECTION_MARGIN = 2.0  # a bundle adjustment makes a direction's sigma 0.5 to 1.7 times what it was (70 pairs)


class Initialiser:
    """Collects views until two of them start a map."""

    def __init__(
        self,
        frontend: Frontend,
        adjuster: BundleAdjuster,
        config: InitialiserConfig,
        K: FloatArray,
        size_px: tuple[int, int],
        seed: int,
    ) -> None:
        self._frontend = frontend
        if config.matching == "gms":
            nearest_search(frontend)  # a front end without it is refused before the first frame
        self._config = config
        self._K = K
        self._size_px = size_px
        self._seed = seed
        self._proof = StartProof(frontend, adjuster, K, size_px, seed)
        self._views: list[View] = []
        self._turn = self._top = len(LAGS) - 1  # of `LAGS`: the next, and the one that the turn began with
        self._late = cycle(LATE_LAGS)

    def collect(self, view: View) -> None:
        """Keep a view as a possible first view, without trying to start from it."""
        self._views = [*self._views[-START_REACH:], view]

    def add(self, view: View, waited_s: float = 0.0, briefly: bool = False) -> Start | Failure:
        """Take a view in and try to start from it and an earlier one: with the next two in turn, `briefly` with one.

        Views that have enough in common with it are tried in turn, the farthest back first, until one shows too little
        parallax. The turn then begins anew, one farther back if there is one.
        """
        self.collect(view)
        lenience = float(np.clip(waited_s / PATIENCE_S, 1.0, MAX_LENIENCE))
        best = Failure(FailureReason.TOO_FEW_MATCHES, "one view")
        if len(view.features) < PAIR_MATCHES:
            gate = Gate("features", len(view.features), ">=", PAIR_MATCHES)
            return Failure(FailureReason.NO_TEXTURE, f"{len(view.features)} features in the image", gates=(gate,))
        farthest = sum(lag < len(self._views) for lag in LAGS) - 1
        for _ in range(1 if briefly else MAX_PAIRS):
            if farthest < 0:
                break
            at = min(self._turn, farthest)
            start = self.try_pair(len(self._views) - 1 - LAGS[at], len(self._views) - 1, lenience)
            if start:
                return start
            assert isinstance(start, Failure)
            best = start
            if start.reason in (FailureReason.TOO_FEW_MATCHES, FailureReason.NO_TEXTURE):
                self._top = max(at - 1, 0)
            if at == 0 or start.reason is FailureReason.LOW_PARALLAX:
                self._turn = self._top = min(self._top + 1, farthest)
                if self._turn == at:
                    break  # it would be this pair once more
            else:
                self._turn = at - 1
        for _ in range(0 if briefly else MAX_PAIRS):
            if len(self._views) > (lag := next(self._late)):
                start = self.try_pair(len(self._views) - 1 - lag, len(self._views) - 1, lenience)
                if start:
                    return start
        return best

    def try_pair(self, first: int, last: int, lenience: float = 1.0) -> Start | Failure:
        """Try to start from two of the collected views (positions in the list).

        `lenience`: how many times less well than asked for the direction may be known. Where they show too little
        parallax, the failure's numbers hold how much the image has moved.
        """
        a, b = self._views[first], self._views[last]
        matches = self._match(a.features, b.features)
        if len(matches) < PAIR_MATCHES:
            gate = Gate("matches", len(matches), ">=", PAIR_MATCHES)
            detail = f"{len(matches)} matches, {PAIR_MATCHES} needed"
            return Failure(FailureReason.TOO_FEW_MATCHES, detail, gates=(gate,))
        pair = self._best_pose(a, b, matches)
        start = (
            self._proof.verify(pair, [a, *self._witnesses(pair, first, last), b])
            if isinstance(pair, ViewPair)
            else pair
        )
        if isinstance(start, Start):
            direction = start.numbers["direction_sigma_deg"]
            most_deg = lenience * MAX_DIRECTION_SIGMA_DEG
            if not direction < most_deg:
                start = _direction_unknown(direction, most_deg, start.numbers)
            elif last - first > LAGS[-1]:
                start = _few_are_chance(start)
        if isinstance(start, Failure) and start.reason is FailureReason.LOW_PARALLAX:
            return replace(start, numbers={**start.numbers, "shift_px": _shift_px(a, b, matches)})
        return start

    # --- two views

    def _match(self, a: Features, b: Features) -> Matches:
        """Match the two views; the frames between them have few points to find, too few for motion statistics."""
        if self._config.matching == "gms":
            return match_by_motion(self._frontend, a, b)
        return self._frontend.match_wide(a, b)

    def _best_pose(self, a: View, b: View, matches: Matches) -> ViewPair | Failure:
        fa, fb = matches.index[:, 0], matches.index[:, 1]
        uv_a, uv_b = a.features.uv_rect_px[fa], b.features.uv_rect_px[fb]
        sigma = np.maximum(a.features.sigma_px[fa], b.features.sigma_px[fb])
        poses = RelativePoses(uv_a, uv_b, sigma, self._K, self._size_px, self._seed)
        if poses.n_moved < int(NEAR * START_POINTS):
            detail = f"a turn explains all but {poses.n_moved} of {len(matches)} matches"
            gate = Gate("matches that no turn explains", poses.n_moved, ">=", int(NEAR * START_POINTS))
            return Failure(FailureReason.LOW_PARALLAX, detail, gates=(gate,))
        pairs = [self._evaluate(a, b, matches, T_b_a) for T_b_a in poses.of_turns()]
        if (hopeless := self._hopeless(pairs, len(matches))) is not None:
            return hopeless
        of_most = self._evaluate(a, b, matches, poses.of_essential_matrix())
        pairs = [of_most, *pairs]
        if (hopeless := self._hopeless(pairs, len(matches))) is not None:
            return hopeless
        pairs += [self._evaluate(a, b, matches, T_b_a) for T_b_a in poses.of_plane(of_most.T_b_a)]
        contenders = _contenders(pairs, len(matches), max(pair.n_explained for pair in pairs))
        best = max(contenders, key=lambda p: int(p.good.sum()))
        n_good = int(best.good.sum())
        numbers = {"n_matches": float(len(matches)), "n_points": float(n_good), "parallax_deg": best.parallax_deg}
        enough = Gate("points", n_good, ">=", START_POINTS)
        near = Gate("near points", best.n_near, ">=", NEAR * START_POINTS)
        if not enough.passed:
            detail = f"{n_good} points of {len(matches)} matches"
            return Failure(FailureReason.TOO_FEW_INLIERS, detail, numbers, gates=(enough,))
        if not near.passed:
            detail = f"median parallax {best.parallax_deg:.2f} deg, {best.n_near} near points"
            return Failure(FailureReason.LOW_PARALLAX, detail, numbers, gates=(enough, near))
        if any(direction_angle_deg(best.T_b_a, other.T_b_a) > SAME_DEG for other in contenders):
            return Failure(FailureReason.AMBIGUOUS_MODEL, "two poses explain the views alike", numbers)
        if (direction := self._direction_sigma_deg(best)) > DIRECTION_MARGIN * MAX_DIRECTION_SIGMA_DEG:
            return _direction_unknown(direction, DIRECTION_MARGIN * MAX_DIRECTION_SIGMA_DEG, numbers)
        return best

    def _hopeless(self, pairs: list[ViewPair], n_matches: int) -> Failure | None:
        """Return why no start comes of two views, whatever else explains them; None where that is open.

        It spares most pairs of a camera that turns on the spot what is dear about a pair. Of poses that explain so much
        that none could refute them, two differ, or one does not fix its direction.
        """
        sure = _contenders(pairs, n_matches, n_matches)
        # The best pose, whichever it is, is far from one of two that are twice as far apart.
        if any(direction_angle_deg(p.T_b_a, q.T_b_a) > 2 * SAME_DEG for p, q in combinations(sure, 2)):
            return Failure(FailureReason.AMBIGUOUS_MODEL, "two poses explain the views alike")
        loosest_deg = DIRECTION_MARGIN * MAX_DIRECTION_SIGMA_DEG
        for pair in sure:
            has_points = pair.good.sum() >= START_POINTS
            if has_points and (direction := self._direction_sigma_deg(pair)) > loosest_deg:
                return _direction_unknown(direction, loosest_deg, {})
        return None

    def _direction_sigma_deg(self, pair: ViewPair) -> float:
        """Return how well two views alone know the direction, before any bundle adjustment."""
        sigma_px = pair.b.features.sigma_px[pair.matches.index[pair.good, 1]]
        return direction_sigma_deg(self._K, se3.IDENTITY, se3.inverse(pair.T_b_a), pair.xyz[pair.good], sigma_px)

    def _evaluate(self, a: View, b: View, matches: Matches, T_b_a: FloatArray) -> ViewPair:
        fa, fb = matches.index[:, 0], matches.index[:, 1]
        points = triangulate_two_view(
            a.features.uv_rect_px[fa], b.features.uv_rect_px[fb], self._K, se3.IDENTITY, se3.inverse(T_b_a)
        )
        uv_a, uv_b, sigma_b = a.features.uv_rect_px[fa], b.features.uv_rect_px[fb], b.features.sigma_px[fb]
        fits = (points.error2_a < CHI2_95[2] * a.features.sigma_px[fa] ** 2) & (
            points.error2_b < CHI2_95[2] * sigma_b**2
        )
        good = fits & (points.depth_a > 0) & (points.depth_b > 0)
        moved_px = np.linalg.norm(_turned(uv_a, self._K, T_b_a) - uv_b, axis=1)
        n_explained = int((good | (fits & (moved_px < GATE_SIGMAS * sigma_b))).sum())
        angle = np.degrees(np.arccos(np.clip(points.cos_parallax[good], -1, 1)))
        # Points without parallax are no points of the map: their depth is anything.
        good[good] = angle > MIN_PARALLAX_DEG / 2
        parallax = float(np.median(angle)) if len(angle) else 0.0
        n_near = int((angle >= MIN_PARALLAX_DEG).sum())
        return ViewPair(a, b, matches, T_b_a, points.xyz, good, n_explained, parallax, n_near)

    # --- witnesses

    def _witnesses(self, pair: ViewPair, first: int, last: int) -> list[View]:
        """Views spread evenly between the two; between two far apart, among those that see their points."""
        seeing = np.arange(first, last + 1)
        if last - first > LAGS[-1]:
            points = pair.a.features.take(pair.matches.index[pair.good, 0])
            every = LAGS[2]  # nearer ones see much the same
            between = [p for p in range(first + every, last, every) if self._sees(self._views[p], points)]
            seeing = np.array([first, *between, last])
        among = np.linspace(0, len(seeing) - 1, PROOF_VIEWS + 2)[1:-1]
        positions = sorted({int(seeing[round(place)]) for place in among} - {first, last})
        return [self._views[p] for p in positions if len(self._views[p].features) >= START_POINTS]

    def _sees(self, view: View, points: Features) -> bool:
        return len(self._frontend.match_wide(points, view.features)) >= START_POINTS // 2


def _direction_unknown(direction_sigma_deg: float, most_deg: float, numbers: dict[str, float]) -> Failure:
    detail = f"direction of translation known to {direction_sigma_deg:.1f} deg only"
    gate = Gate("sigma of the direction of translation in degrees", direction_sigma_deg, "<", most_deg)
    return Failure(FailureReason.LOW_PARALLAX, detail, numbers, gates=(gate,))


def _few_are_chance(start: Start) -> Start | Failure:
    """Refuse a start of two views far apart if three views prove fewer points than any start needs.

    In a turn two frames share a part of the image only, where a turn and a step look the same.
    """
    proven = Gate("points that three views prove", start.numbers["n_proven"], ">=", START_POINTS)
    if proven.passed:
        return start
    detail = f"three views prove {start.numbers['n_proven']:.0f} points of two views far apart"
    return Failure(FailureReason.DOUBTFUL_INITIALISATION, detail, start.numbers, gates=(proven,))


def _contenders(pairs: list[ViewPair], n_matches: int, most: int) -> list[ViewPair]:
    """Return the pairs whose pose explains nearly as many matches as the one that explains `most`.

    Points without parallax count too: beside a near plane, a pose that takes a turn for parallax has more points.
    """
    bound = UNEXPLAINED_TIMES * (n_matches - most) + UNEXPLAINED_MORE
    return [p for p in pairs if p.n_explained >= RUNNER_UP * most and n_matches - p.n_explained <= bound]


def _turned(uv_a: FloatArray, K: FloatArray, T_b_a: FloatArray) -> FloatArray:
    """Return where pixels of the first view are in the second if they show what is infinitely far."""
    rays = np.column_stack([uv_a, np.ones(len(uv_a))]) @ (K @ se3.rotation(T_b_a) @ np.linalg.inv(K)).T
    return np.asarray(rays[:, :2] / np.where(np.abs(rays[:, 2:]) > TINY, rays[:, 2:], np.nan))


def _shift_px(a: View, b: View, matches: Matches) -> float:
    """Return by how much matches have moved in the image (median)."""
    moved = b.features.uv_rect_px[matches.index[:, 1]] - a.features.uv_rect_px[matches.index[:, 0]]
    return float(np.median(np.linalg.norm(moved, axis=1)))
