"""All submaps of a run, the links between them, and the solution that places them."""
