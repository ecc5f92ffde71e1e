"""Index of a submap's factors, present and due: pure numpy, no solver."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dualslam.backend.observability import compute_depth_sigmas, compute_residuals, numbered, take_mask
from dualslam.backend.selection import Candidates, choose_factors
from dualslam.core.config.settings import GraphConfig
from dualslam.core.geometry import se3
from dualslam.core.noise_model import COVISIBLE, MAX_DEPTH_SIGMA, MIN_DEPTH_MU, MIN_LANDMARKS, PROOF_VIEWS
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.map.submap import Submap
from dualslam.map.tables import Table

YOUNG_KEYFRAMES = 5
"""Up to so many keyframes two views are enough, or there would be no graph to start with."""
ENTER_SIGMAS = 6.0
"""Observations of a landmark that is new to the graph must fit within so many sigmas: two views of which one is wrong
throw their point behind a camera, and the solver fails."""
INSERT_SIGMAS = 25.0
"""Observations of a landmark that is in the graph are refused only beyond this; the robust kernel has the rest."""

OUTSIDE = -1
SMALL_MAP = 20
"""Keyframes up to which all that a graph can bear are factors: in a small map every observation counts, and none costs
much. At the next keyframe the choice is made anew."""
ALL = 1 << 30
FACTORS_PER_LANDMARK = 6
"""Views of a landmark that become factors, spread over its track; more where a keyframe would be short of them."""
BUDGET, MOST_RATIO = 3000, 2.5
"""Factors of all keyframes that see what the newest ones see, about: with fewer such keyframes each has more of them,
up to so many times `GraphConfig.factors_per_keyframe`."""
N_NEWEST = 3
"""Keyframes that are the newest."""
LEAVE_RATIO = 2.0
"""A landmark leaves the graph at this many times the uncertainty at which it may enter, so that it does not flutter."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """The changes that bring a graph up to date with its submap."""

    # Observation rows that are admitted from now on, and no more.
    entering: IntArray  # (R,)
    leaving: IntArray  # (R,)
    # Rows whose factors are added, and removed: those of the admitted that are chosen (`dualslam.backend.selection`).
    adding: IntArray  # (R,)
    removing: IntArray  # (R,)
    refused: IntArray  # (R,): live rows that fit so badly that they are not let in
    new_landmarks: IntArray  # (L,)
    new_keyframes: IntArray  # (K,)
    gone_keyframes: IntArray  # (K,)
    weak_keyframes: IntArray
    """(K,): all keyframes that the graph, as it will be, ties to fewer than `MIN_LANDMARKS` well-seen landmarks."""


class FactorIndex:
    """Row by row, what becomes of each observation; it grows with the submap's table, and shrinks with it.

    - `rows`: ``admitted`` (whether the graph can bear it), ``factor`` (index in the solver, or `OUTSIDE`), ``uv_px``
      (2), ``sigma_px``: one row per observation row. Pixels never change, so they are looked up once.
    - `keyframes`: those whose pose is in the graph.
    - `banned`: landmarks that made the solver fail. They stay out until they are observed again.
    """

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self.rows = Table(
            admitted=(np.bool_, ()), factor=(np.int64, ()), uv_px=(np.float64, (2,)), sigma_px=(np.float64, ())
        )
        self.keyframes: set[int] = set()
        self.banned: set[int] = set()
        self._n_planned = 0
        self._n_dropped = 0
        self._chosen_with = self._per_keyframe = ALL

    def clear(self) -> None:
        """Forget what is in the graph (not the pixels, not the bans)."""
        self.rows["factor"][:] = OUTSIDE
        self.rows["admitted"][:] = False
        self.keyframes = set()
        self._n_planned = 0
        self._chosen_with = self._per_keyframe = ALL

    def knows_rows_of(self, submap: Submap) -> bool:
        """Whether its rows are the submap's: none have left the table without its knowing."""
        return submap.n_dropped == self._n_dropped

    def rows_out(self, submap: Submap) -> IntArray:
        """Return the rows that are dead and not in the graph any more."""
        if not self.knows_rows_of(submap):
            return np.zeros(0, np.int64)
        alive = submap.observations["alive"][: self._n_planned]
        return np.flatnonzero(~alive & ~self._held()[: self._n_planned])

    def keep(self, rows: IntArray) -> None:
        """Follow a submap in which only these rows stay. Where the graph has others, it does not: it is made anew."""
        own = rows[rows < len(self.rows)]
        held = self._held()
        if np.count_nonzero(held[own]) < np.count_nonzero(held):
            return
        self._n_dropped += len(self.rows) - len(own)
        self._n_planned = int(np.searchsorted(own, self._n_planned))
        self.rows = self.rows.taken(own)

    def plan(
        self,
        submap: Submap,
        poses: Mapping[int, FloatArray],
        xyz_mu: FloatArray,
        caution: float = 1.0,
        strict: bool = True,
        suspects: IntArray | None = None,
        choose: bool = True,
    ) -> Plan:
        """Compare the submap with the graph; nothing changes until `commit`.

        - `poses` (mapping of int to (4, 4)): ``T_submap_kf`` to judge by (normally the submap's).
        - `xyz_mu` (L, 3): points to judge by (normally the submap's).
        - `caution`: above 1 landmarks are asked for that much more certainty.
        - `strict`: hold the observations of new landmarks to `ENTER_SIGMAS`; False before a batch optimisation.
        - `suspects` (S,): landmarks to look at again although nothing of theirs changed.
        - `choose`: whether a part of what is admitted becomes factors; False: all of it.
        """
        self._take_new_rows(submap)
        obs = submap.observations
        kf, lm, alive = obs["kf"], obs["landmark"], obs["alive"]
        n_landmarks = len(submap.landmarks)
        inside = self.rows["admitted"]
        died = inside & ~alive
        # A landmark is looked at again where it got an observation (touched) or lost one.
        fresh = self._n_planned + np.flatnonzero(alive[self._n_planned :])
        touched = take_mask(lm[fresh], n_landmarks)
        lost = take_mask(lm[died], n_landmarks)
        if suspects is not None:
            lost[suspects] = True
        if self._n_planned:
            self.banned.difference_update(lm[fresh].tolist())
        known = take_mask(lm[inside], n_landmarks)
        allowed = touched.copy()
        allowed[list(self.banned)] = False
        row = np.flatnonzero(alive & np.where(inside, lost[lm], allowed[lm]))
        gate = np.where(known | (not strict), INSERT_SIGMAS, ENTER_SIGMAS)
        fits, certain = self._judge(submap, poses, xyz_mu, row, inside, known, known & ~lost, gate, caution)

        leaving = died | (inside & (known & ~certain & lost)[lm])
        candidate = ~inside[row]
        entering = np.zeros(len(lm), bool)
        entering[row[candidate & fits & certain[lm[row]]]] = True
        refused = row[candidate & ~fits]
        leaving[row[~candidate & ~fits]] = True  # behind the camera after all: such a factor has no derivative
        admitted = (inside & ~leaving) | entering

        factors = self.rows["factor"] >= 0
        chosen = self._choose(submap, admitted, factors, choose)
        new_landmarks = np.flatnonzero(take_mask(lm[chosen], n_landmarks) & ~take_mask(lm[factors], n_landmarks))
        live = np.array(sorted(submap.keyframes), np.int64)
        here = np.array(sorted(self.keyframes), np.int64)
        weak = self._weak_keyframes(chosen, kf, lm, live)
        return Plan(
            np.flatnonzero(entering),
            np.flatnonzero(leaving),
            np.flatnonzero(chosen & ~factors),
            np.flatnonzero(factors & ~chosen),
            refused,
            new_landmarks,
            np.setdiff1d(live, here, assume_unique=True),
            np.setdiff1d(here, live, assume_unique=True),
            weak,
        )

    def commit(self, plan: Plan, factor_of_adding: IntArray) -> None:
        """Take over that the solver has accepted a plan, and the factor indices that it gave."""
        self.rows["admitted"][plan.leaving] = False
        self.rows["admitted"][plan.entering] = True
        self.rows["factor"][plan.removing] = OUTSIDE
        self.rows["factor"][plan.adding] = factor_of_adding
        self.keyframes.update(plan.new_keyframes.tolist())
        self.keyframes.difference_update(plan.gone_keyframes.tolist())
        self._n_planned = len(self.rows)
        self._chosen_with = self._per_keyframe

    def _choose(self, submap: Submap, admitted: BoolArray, factors: BoolArray, a_part: bool) -> BoolArray:
        """Return which of the admitted rows are to be factors."""
        obs = submap.observations
        keyframes = np.array(list(submap.keyframes), np.int64)
        self._per_keyframe = self._factors_per_keyframe(submap, admitted, keyframes) if a_part else ALL
        if 2 * self._per_keyframe <= self._chosen_with:
            factors = np.zeros_like(factors)
        young = len(keyframes) <= YOUNG_KEYFRAMES
        return choose_factors(
            # The image's middle is about where the principal point is.
            Candidates(obs["kf"], obs["landmark"], self.rows["uv_px"], 2 * float(submap.K[0, 2])),
            admitted,
            factors,
            keyframes,
            len(submap.landmarks),
            self._per_keyframe,
            FACTORS_PER_LANDMARK if self._per_keyframe < ALL else ALL,
            2 if young else PROOF_VIEWS,
        )

    def _factors_per_keyframe(self, submap: Submap, admitted: BoolArray, keyframes: IntArray) -> int:
        """Return how many factors a keyframe may have: fewer, the more keyframes see what the newest ones see.

        They are what an update takes apart. An answer holds until another is half of it or less.
        """
        config, obs = self._config, submap.observations
        if len(keyframes) <= SMALL_MAP:
            return ALL
        kf, lm = obs["kf"][: len(admitted)][admitted], obs["landmark"][: len(admitted)][admitted]
        seen = take_mask(lm[np.isin(kf, keyframes[-N_NEWEST:])], len(submap.landmarks))
        beside = int(np.count_nonzero(np.bincount(kf[seen[lm]]) >= COVISIBLE))
        wanted = max(
            config.factors_per_keyframe, min(int(MOST_RATIO * config.factors_per_keyframe), BUDGET // max(beside, 1))
        )
        return wanted if 2 * wanted <= self._chosen_with else self._chosen_with

    def _held(self) -> BoolArray:
        """Return a mask of the rows that are in the graph, or factors of the solver still."""
        return np.asarray(self.rows["admitted"] | (self.rows["factor"] >= 0))

    def _take_new_rows(self, submap: Submap) -> None:
        if not self.knows_rows_of(submap):  # the graph is made anew
            self.rows, self._n_dropped = self.rows.taken(np.zeros(0, np.int64)), submap.n_dropped
        obs, n = submap.observations, len(self.rows)
        if len(obs) == n:
            return
        self.rows.append(len(obs) - n, factor=OUTSIDE)
        alive = n + np.flatnonzero(obs["alive"][n:])
        self.rows["uv_px"][alive], self.rows["sigma_px"][alive] = submap.observed_pixels(alive)

    def _judge(
        self,
        submap: Submap,
        poses: Mapping[int, FloatArray],
        xyz_mu: FloatArray,
        row: IntArray,
        inside: BoolArray,
        known: BoolArray,
        trusted: BoolArray,
        gate_sigmas: FloatArray,
        caution: float,
    ) -> tuple[BoolArray, BoolArray]:
        """Return which of the rows fit, and which landmarks are certain enough (`trusted` ones are not asked)."""
        ids, pose = numbered(submap.observations["kf"][row])
        T = se3.stack([poses[k] for k in ids.tolist()])
        point = submap.observations["landmark"][row]
        sigma = self.rows["sigma_px"][row]
        res = compute_residuals(
            submap.K, T, pose, xyz_mu.take(point, axis=0), self.rows["uv_px"].take(row, axis=0), sigma
        )
        fits = np.where(inside[row], res.depth_mu > MIN_DEPTH_MU, res.chi2 < gate_sigmas[point] ** 2)
        asked = fits & ~trusted[point]
        certain = trusted.copy()
        names, index = numbered(point[asked])
        sigmas = compute_depth_sigmas(submap.K, T, pose[asked], res.xyz_cam[asked], sigma[asked], index, len(names))
        limit = MAX_DEPTH_SIGMA / caution * np.where(known[names], LEAVE_RATIO, 1.0)
        # Two views of a point fit whatever the poses are along their epipolar lines: only the third tests them.
        n_views = np.bincount(index, minlength=len(names))
        young = len(submap.keyframes) <= YOUNG_KEYFRAMES
        enough = n_views >= np.where(known[names] | young, 2, PROOF_VIEWS)
        certain[names] = (sigmas < limit) & enough
        return fits, certain

    def _weak_keyframes(self, inside: BoolArray, kf: IntArray, lm: IntArray, live: IntArray) -> IntArray:
        # A landmark of two views ties its two keyframes up to scale only: it takes a third to hold one of them.
        k, j = kf[inside], lm[inside]
        held = np.bincount(j)[j] >= 3 if len(j) else np.zeros(0, bool)
        ties = np.bincount(k[held], minlength=int(live.max(initial=0)) + 1)
        return live[ties[live] < MIN_LANDMARKS]
