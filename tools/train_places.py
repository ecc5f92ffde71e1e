"""Train the cells of the place index on rendered worlds alone, and write them where the package ships them.

    python tools/train_places.py

No photograph has a part in them, so that no licence but ours lies on them. The worlds' seeds are none that the
benchmarks use.
"""

from __future__ import annotations

from pathlib import Path

import faiss
import numpy as np

import dualslam
from dualslam.build import create_frontend
from dualslam.core.config.settings import FrontendConfig
from dualslam.places.faiss_index import CELLS

SOURCES = (
    *(f"synthetic:street,frames=240,seed={seed}" for seed in (90001, 90002)),
    *(f"synthetic:room,frames=160,seed={seed}" for seed in (90003, 90004)),
)
N_CELLS = 1024
EVERY = 8  # frames between two that are learnt from


def main() -> None:
    """Train and write."""
    frontend = create_frontend(FrontendConfig())
    found = []
    for source in SOURCES:
        n = 0
        for frame in dualslam.open_source(source):
            if frame.index % EVERY == 0 and frame.image is not None:
                found.append(frontend.extract(frame.image).descriptors)
                n += len(found[-1])
        print(f"{source}: {n} descriptors")
    descriptors = np.unique(np.concatenate(found), axis=0)
    faiss.omp_set_num_threads(1)
    bits = 8 * descriptors.shape[1]
    index = faiss.IndexBinaryIVF(faiss.IndexBinaryFlat(bits), bits, N_CELLS)
    index.train(np.ascontiguousarray(descriptors))
    quantizer = faiss.downcast_IndexBinary(index.quantizer)
    cells = faiss.vector_to_array(quantizer.xb).reshape(N_CELLS, -1)
    np.save(Path(CELLS), cells, allow_pickle=False)
    print(f"{len(descriptors)} descriptors -> {cells.shape} in {CELLS}")


if __name__ == "__main__":
    main()
