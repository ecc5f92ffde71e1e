"""Measure what README, docs/index.md and docs/results.md claim, and write the tables there, each with its commit.

    python benchmarks/results.py --data DIR [--part sequences] [--part realtime] [--part failures] [--part links]
                                 [--seeds 5] [--trials 4] [--worlds 8] [--jobs 2] [--out runs/results] [--write-only]

`make results DATA=DIR` is the same. DIR holds `kitti_03`, `7scenes_1000`, `tum_fr1_rpy` and `hololens_000`, each with
an `images` folder, as `dualslam run` reads them. Each part notes the commit that it is measured at: a part that was
stopped goes on where it was, and one that was begun at another commit is refused, so that a table has one commit. Parts
of one folder may have different ones, and `--write-only` writes those that are there; what was not measured stays in
the pages as it was. All seeds are of the reporting half.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
PARTS = ("sequences", "realtime", "failures", "links")
FIRST_SEED = 100
CONDITIONS: dict[str, list[str]] = {"": [], "recovery off": ["--no-recovery"]}
BLACK = ("kitti_03", "7scenes_1000")
BLACK_FRAMES = 10
SHORT = "failures in short"
BESIDE = "beside ORB-SLAM3"
PEER = {
    "kitti_03": "99.9, 0.81, 95",
    "7scenes_1000": "97.2, 0.041, 48",
    "tum_fr1_rpy": "81.7, 0.057, 36",
    "euroc_takeoff": "77.1, 0.0079, 49",
    "hololens_000": "21.2, 0.15, 23",
}
"""ORB-SLAM3 (`pyorbslam3` 0.1.1, a vocabulary of 88,000 descriptors) at the camera's rate on two cores, in
November 2026: coverage in %, ATE in m, CPU ms a frame."""


def main() -> None:
    """Measure what is missing, then write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--part", action="append", choices=PARTS)
    parser.add_argument("--seeds", type=int, default=5, help="of each whole sequence")
    parser.add_argument("--trials", type=int, default=4, help="of each sequence and condition of the failure bench")
    parser.add_argument("--worlds", type=int, default=8, help="of each kind of failure in rendered worlds")
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time: their CPU times suffer from it")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "results")
    parser.add_argument("--write-only", action="store_true", help="from what was measured so far")
    args = parser.parse_args()
    parts = [] if args.write_only else args.part or PARTS
    if args.data is None and set(parts) - {"links"}:
        parser.error("sequences and failures need --data")
    commit = _git("describe", "--always", "--dirty")
    for part in parts:
        begin(args.out, part, commit)
    for part in parts:
        MEASURE[part](args)
    write(args.out)


def begin(out: Path, part: str, commit: str) -> None:
    """Note the commit of a part; end the program where it was begun at another one."""
    note = _note_of_commit(out, part)
    if note.exists() and note.read_text().strip() != commit:
        begun = note.read_text().strip()
        sys.exit(f"{part} in {out} were measured at {begun}, this is {commit}: another --out, or --write-only")
    out.mkdir(parents=True, exist_ok=True)
    note.write_text(commit + "\n")


def _note_of_commit(out: Path, part: str) -> Path:
    return out / f"{part}.commit.txt"


# --- measuring


def measure_sequences(args: argparse.Namespace) -> None:
    """Run each whole sequence with each seed, with recovery and without; two of them with black frames half-way."""
    runs: list[tuple[object, ...]] = []
    for folder in sorted(path for path in args.data.iterdir() if (path / "images").is_dir()):
        for condition, options in [*CONDITIONS.items(), *_black(folder, args.out)]:
            runs += _runs(args, folder, Path("sequences", folder.name, condition or "as it is"), options)
    with ThreadPoolExecutor(args.jobs) as pool:
        for _ in pool.map(lambda run: _run(*run), runs):  # one that fails ends those that have not begun
            pass


def measure_realtime(args: argparse.Namespace) -> None:
    """Run the sequences of `PEER` at the camera's rate, one after the other."""
    for name in PEER:
        for run in _runs(args, args.data / name, Path("realtime", name), ["--realtime", "--workers", "1"]):
            _run(*run)


def _runs(args: argparse.Namespace, folder: Path, place: Path, options: list[str]) -> list[tuple[object, ...]]:
    """Return the runs of a sequence that are missing, one for each seed."""
    seeds = range(FIRST_SEED, FIRST_SEED + args.seeds)
    outs = {seed: args.out / place / str(seed) for seed in seeds}
    return [
        ("run", folder, "--out", out, "--overwrite", "--quiet", "--seed", seed, *options)
        for seed, out in outs.items()
        if not (out / "summary.json").exists()
    ]


def _black(folder: Path, out: Path) -> list[tuple[str, list[str]]]:
    """Return the conditions with the lens covered half-way."""
    if folder.name not in BLACK:
        return []
    start = len(list((folder / "images").iterdir())) // 2
    script = out / f"{folder.name}_black.yaml"
    script.write_text(yaml.safe_dump([{"kind": "blackout", "start": start, "length": BLACK_FRAMES}]))
    corrupt = ["--corrupt", str(script)]
    name = f"{BLACK_FRAMES} black frames"
    return [(name, corrupt), (f"{name}, recovery off", [*corrupt, "--no-recovery"])]


def measure_failures(args: argparse.Namespace) -> None:
    """Run the bench of causes that lose a map."""
    spec, out = ROOT / "benchmarks" / "failures.yaml", args.out / "failures"
    _run("bench", spec, "--data", args.data, "--out", out, "--trials", args.trials, "--jobs", args.jobs, "--quiet")


def measure_links(args: argparse.Namespace) -> None:
    """Run rendered worlds in which exact truth says how true each link is."""
    command = [sys.executable, ROOT / "benchmarks" / "synthetic_recovery.py", "--out", args.out / "links.jsonl"]
    subprocess.run([*map(str, command), "--runs", str(args.worlds), "--jobs", str(args.jobs)], check=True, cwd=ROOT)


MEASURE = {
    "sequences": measure_sequences,
    "realtime": measure_realtime,
    "failures": measure_failures,
    "links": measure_links,
}


def _run(*arguments: object) -> None:
    done = subprocess.run([sys.executable, "-m", "dualslam.cli", *map(str, arguments)], check=False, cwd=ROOT)
    if done.returncode not in (0, 1):  # 1: no map, which is a result
        sys.exit(done.returncode)


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], check=True, capture_output=True, text=True, cwd=ROOT).stdout.strip()


# --- writing


def write(out: Path) -> None:
    """Put the tables that were measured into README.md and two pages of docs, between their marks."""
    realtime = {name: _read(out / "realtime" / name) for name in PEER}
    tables = {
        "sequences": sequences_table(out),
        "realtime": realtime_table(realtime),
        "failures": failures_tables(out),
        "links": links_table(out),
    }
    tables[SHORT], tables[f"realtime {BESIDE}"] = short_table(tables["failures"]), beside_table(realtime)
    short = (SHORT, f"realtime {BESIDE}")
    for page, parts in (("README.md", short), ("docs/index.md", short), ("docs/results.md", PARTS)):
        text = (ROOT / page).read_text()
        for part in parts:
            if table := tables[part]:
                note = _note_of_commit(out, part.split()[0])
                if not note.exists():
                    sys.exit(f"{note} is missing: nothing says at which commit {part} were measured")
                commit = note.read_text().strip()
                text = _filled(text, part, f"Commit `{commit}`, `make results`.\n\n{table}\n")
        (ROOT / page).write_text(text)


def _filled(text: str, part: str, content: str) -> str:
    """Return a page's text with one part's place filled anew."""
    pattern = rf"(<!-- results: {part} -->\n).*?(<!-- end -->)"
    text, n = re.subn(pattern, lambda m: m[1] + content + m[2], text, flags=re.DOTALL)
    assert n == 1, f"{n} places for {part}"
    return text


def sequences_table(out: Path) -> str | None:
    """Return a row for each sequence and condition: medians over the seeds, the worst in brackets."""
    rows = []
    for folder in sorted((out / "sequences").glob("*/*"), key=lambda path: (path.parent.name, path.name)):
        if runs := _read(folder):
            joined = sum(run["recoveries"] + run["relocalised"] + run["merges"] for run in runs)
            lost = str(sum(run["failures"] for run in runs))
            cells = (
                folder.parent.name,
                folder.name,
                *_quality(runs),
                lost,
                str(joined),
                _median([run["cpu_ms_per_frame"] for run in runs], max, 0),
            )
            rows.append(_line(cells))
    names = ("sequence", "condition", *QUALITY, "maps lost", "joined again", "CPU ms a frame")
    return "\n".join([_line(names), "|" + "---|" * len(names), *rows]) if rows else None


def realtime_table(realtime: dict[str, list[dict[str, Any]]]) -> str | None:
    """Return a row for each sequence at the camera's rate."""
    rows = []
    for name, runs in realtime.items():
        if runs:
            latency = (_median([run["latency_ms"][q] for run in runs], max, 0) for q in ("median", "p99"))
            dropped = _median([100 * run["dropped"] / run["frames"] for run in runs], max, 1)
            cells = (
                name,
                *_quality(runs),
                dropped,
                *latency,
                _median([run["cpu_ms_per_frame"] for run in runs], max, 0),
                PEER[name],
            )
            rows.append(_line(cells))
    names = (
        "sequence",
        *QUALITY,
        "dropped %",
        "latency ms p50",
        "p99",
        "CPU ms a frame",
        "ORB-SLAM3: coverage %, ATE m, CPU",
    )
    return "\n".join([_line(names), "|" + "---|" * len(names), *rows]) if rows else None


def beside_table(realtime: dict[str, list[dict[str, Any]]]) -> str | None:
    """Return coverage and ATE beside ORB-SLAM3's."""
    if not all(realtime.values()):
        return None
    theirs = (peer.rsplit(", ", 1)[0] for peer in PEER.values())
    ours = [
        ", ".join(f"{statistics.median(run[key] for run in runs):.3g}" for key in ("coverage_pct", "ate_rmse_m"))
        for runs in realtime.values()
    ]
    header = _line(("coverage %, ATE m", *PEER))
    return "\n".join(
        [header, "|" + "---|" * (len(PEER) + 1), _line(("ORB-SLAM3", *theirs)), _line(("dualslam", *ours))]
    )


QUALITY = ("seeds", "coverage %", "ATE m", "broken stretches", "verdicts")


def _read(folder: Path) -> list[dict[str, Any]]:
    """Return the summaries of a folder's runs, each with its score."""
    runs = [(path.parent, json.loads(path.read_text())) for path in sorted(folder.glob("*/summary.json"))]
    return [{**summary, **score_of(run, summary["source"])} for run, summary in runs]


def score_of(run: Path, source: str) -> dict[str, Any]:
    """Return what `dualslam eval` says of a run; nothing of one whose sequence has no ground truth."""
    command = [sys.executable, "-m", "dualslam.cli", "eval", str(run), source, "--json"]
    done = subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True)
    return dict(json.loads(done.stdout)) if done.returncode == 0 else {}


def _quality(runs: list[dict[str, Any]]) -> tuple[str, ...]:
    scored = [run for run in runs if run.get("broken") is not None]
    broken = ", ".join(f"{run['broken']} of {run['judged']}" for run in scored) or "-"
    verdicts = Counter(run["verdict"]["level"] for run in runs)
    said = ", ".join(level if len(runs) == 1 else f"{n} {level}" for level, n in verdicts.items())
    coverage = _median([100 * run["coverage"] for run in runs], min, 1)
    ate = _median([run["ate_rmse_m"] for run in runs if run.get("ate_rmse_m") is not None], max, 4)
    return str(len(runs)), coverage, ate, broken, said


def failures_tables(out: Path) -> str | None:
    """Return what the bench wrote: failures by cause, recoveries by attempt, independence of attempts."""
    page = out / "failures" / "tables.md"
    if not page.exists():
        return None
    sections = re.split(r"(?m)^(?=### )", page.read_text())
    wanted = [s.strip() for s in sections if s.startswith(("### Table II", "### Table III", "### Eq. (1)"))]
    return "\n\n".join(wanted)


def short_table(tables: str | None) -> str | None:
    """Return the failed trials by kind of recording, without recovery and with it, from the failure bench's tables."""
    rows = re.findall(r"(?m)^\| data: ([\w-]+) \| (base|Dual) \| (\d+) \| (\d+) \|", tables or "")
    failed = {(data, variant): f"{failures} of {trials}" for data, variant, failures, trials in rows}
    kinds = dict.fromkeys(data for data, _ in failed)
    lines = [_line((kind, failed.get((kind, "base"), "-"), failed.get((kind, "Dual"), "-"))) for kind in kinds]
    return (
        "\n".join([_line(("recordings", "failed, recovery off", "failed, recovery on")), "|---|---|---|", *lines])
        if lines
        else None
    )


def links_table(out: Path) -> str | None:
    """Return the table of links against exact truth."""
    records = out / "links.jsonl"
    if not records.exists():
        return None
    sys.path.insert(0, str(ROOT / "benchmarks"))
    from synthetic_recovery import table

    return str(table([json.loads(line) for line in records.read_text().splitlines()]))


def _median(values: list[float], worst: Any, digits: int) -> str:
    """Return the median, and the worst in brackets where there are several."""
    if not values:
        return "-"
    middle = f"{statistics.median(values):.{digits}f}"
    return middle if len(values) == 1 else f"{middle} ({worst(values):.{digits}f})"


def _line(cells: Any) -> str:
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
