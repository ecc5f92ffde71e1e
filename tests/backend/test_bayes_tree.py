from __future__ import annotations

import numpy as np
import pytest

from dualslam.backend.solver import parse_bayes_tree
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.config.settings import GraphConfig
from dualslam.core.errors import SolverError
from tests.backend.test_submap_graph import grow, start


def test_the_text_of_a_tree_is_read_whatever_its_order() -> None:
    tree = parse_bayes_tree(
        'digraph G{\n1[label="4 : x0, 9"];\n0[label="9, x2, x0"];\n0->1\n0->3\n3[label="5, x7 : x2"];\n}'
    )
    assert tree.parent.tolist() == [-1, 0, 0]
    assert tree.keyframes == ((2, 0), (), (7,))
    assert tree.landmarks == ((9,), (4,), (5,))
    assert tree.separators == ((), (0,), (2,))
    assert tree.separator_landmarks.tolist() == [0, 1, 0]
    assert tree.depth.tolist() == [0, 1, 1]


@pytest.mark.parametrize("n", [12, 24], ids=["all", "a part"])
def test_the_tree_holds_every_variable_once_and_separators_stand_above(n) -> None:
    feeder, graph, rest = start(per_view=200, config=GraphConfig(factors_per_keyframe=30))
    grow(feeder, graph, rest[:n])
    tree = graph.bayes_tree()
    e = graph.full_estimate(feeder.submap)
    frontal = [k for clique in tree.keyframes for k in clique]
    assert sorted(frontal) == e.keyframe_ids.tolist()
    variables = np.unique(feeder.submap.observations["landmark"][graph.factor_rows])
    assert sorted(j for clique in tree.landmarks for j in clique) == variables.tolist()
    assert np.isin(variables, e.landmark_ids).all()
    for clique, separator in enumerate(tree.separators):
        above: set[int] = set()
        parent = int(tree.parent[clique])
        while parent >= 0:
            above |= set(tree.keyframes[parent])
            parent = int(tree.parent[parent])
        assert set(separator) <= above
    assert len(graph.statistics) == 1
    assert 0 < graph.statistics[0].reeliminated <= len(frontal) + len(variables)
    assert np.all(tree.parent < np.arange(len(tree)))


def test_there_is_none_before_the_first_update() -> None:
    graph = ISam2SubmapGraph(GraphConfig())
    assert graph.statistics == ()
    with pytest.raises(SolverError, match="before the first update"):
        graph.bayes_tree()
