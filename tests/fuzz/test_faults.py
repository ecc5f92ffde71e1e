from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.faults import Bench, tried


@pytest.mark.slow
def test_what_happens_to_a_run_costs_no_result(tmp_path: Path) -> None:
    """`make faults` makes more, of other kinds too, that other tests know."""
    bench = Bench.build(tmp_path)
    for seed, kind in enumerate(("kill", "full_disk", "solver")):
        assert tried(kind, seed, tmp_path / kind, bench)[1] is None, (kind, seed)
