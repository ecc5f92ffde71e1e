"""How good a run is: completeness and error against ground truth, over one run and over many."""
