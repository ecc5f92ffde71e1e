"""What simulated measurements make of a run: error without and after an SE(3) alignment, scale, calibration of sigmas.

dualslam run DATA/kitti_03 --inline --out runs/kitti_03
python benchmarks/measurements.py runs/kitti_03 --seeds 5
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from dualslam.core.resources import limit_threads

limit_threads()

import numpy as np

from dualslam.build.parts import measurement_sources, metric_parts
from dualslam.core.config.files import load_run_config
from dualslam.core.geometry import sim3
from dualslam.core.geometry.umeyama import umeyama
from dualslam.core.metric_problem import RowSource
from dualslam.io.export.exported_map import read_stored
from dualslam.io.trajectory_files import read_tum
from dualslam.lab.simulated_measurements import Receiver, poses_at
from dualslam.run.measuring import measure

ENDS_S = 10.0
CHI2_95 = 7.815
CASES = ("plain", "outliers", "ends", "ends_outliers", "offset", "jump", "frozen")


def changed(source: RowSource, case: str, t_end: float) -> RowSource:
    rows = list(source.rows)
    if case.startswith("ends"):
        rows = [row for row in rows if row.values[0] < ENDS_S or row.values[0] > t_end - ENDS_S]
    middle = len(rows) // 2
    for i in range(middle, min(middle + 10, len(rows))):
        t, x, y, z, *sigmas = rows[i].values
        if case == "jump":
            rows[i] = replace(rows[i], values=(t, x + 30.0, y, z, *sigmas))
        if case == "frozen":
            rows[i] = replace(rows[i], values=(t, *rows[middle].values[1:4], *sigmas))
    return replace(source, rows=rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder with groundtruth.txt")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=100)
    args = parser.parse_args()
    stored, truth = read_stored(args.run), read_tum(args.run / "groundtruth.txt")
    parts = metric_parts(load_run_config(args.run))
    print("case           RMSE m med / max   after SE(3) m   scale %   rejected   NEES (3)   in 95 % band")
    for case in CASES:
        rows = []
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            offset = float(np.random.default_rng(seed).uniform(-2, 2)) if case == "offset" else 0.0
            share = 0.1 if "outliers" in case else 0.0
            receiver = Receiver(outlier_share=share, clock_offset_s=offset, seed=seed)
            source = changed(receiver.positions(truth), case, truth.timestamps_s[-1])
            found = measure(stored.atlas, stored.poses, stored.main, measurement_sources([source]), parts)
            T, q = found.frames.T_world_cam, poses_at(truth, found.frames.timestamps_s)[:, :3, 3]
            e = T[:, :3, 3] - q
            in_camera = np.einsum("nji,nj->ni", T[:, :3, :3], e)
            nees = np.einsum("ni,nij,nj->n", in_camera, np.linalg.inv(found.covariance[:, 3:, 3:]), in_camera)
            rigid = umeyama(T[:, :3, 3], q, with_scale=False).rmse
            scale = 100 * abs(float(sim3.scale(umeyama(T[:, :3, 3], q).S_dst_src)) - 1)
            n = found.main.rejected.get("position", 0)
            rows.append((np.sqrt((e**2).sum(1).mean()), rigid, scale, n, nees.mean(), (nees < CHI2_95).mean()))
        m, worst = np.median(rows, axis=0), np.max(rows, axis=0)
        print(
            f"{case:13s}  {m[0]:6.2f} / {worst[0]:5.2f}     {m[1]:5.2f} / {worst[1]:5.2f}   {m[2]:5.2f}     {m[3]:4.0f}"
            f"       {m[4]:5.2f}      {100 * m[5]:3.0f} %",
            flush=True,
        )


if __name__ == "__main__":
    main()
