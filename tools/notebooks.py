"""Run notebooks anew and keep what they print and draw: ``python tools/notebooks.py [NOTEBOOK ...]``, all by default.

Cells and metadata stay as they are. A notebook whose outputs name this machine's folders is not written.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
FOREIGN = (str(ROOT), str(Path.home()) + "/", "/tmp/")


def outputs_of(cell: Any) -> list[dict[str, Any]]:
    """Return a cell's outputs as they are stored: what was printed in one piece, text as lines, without metadata."""
    kept: list[dict[str, Any]] = []
    for output in json.loads(json.dumps(cell["outputs"])):
        if output["output_type"] == "stream" and kept and kept[-1].get("name") == output["name"]:
            kept[-1]["text"] += output["text"]
        else:
            kept.append(output)
    for output in kept:
        if "text" in output:
            output["text"] = output["text"].splitlines(keepends=True)
        for kind, data in output.get("data", {}).items():
            if kind.startswith("text/") and isinstance(data, str):
                output["data"][kind] = data.splitlines(keepends=True)
    return [dict(sorted(output.items())) for output in kept]


def execute(path: Path) -> None:
    """Run one notebook and store its outputs."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    live = nbformat.read(path, as_version=4)
    NotebookClient(live, timeout=600, resources={"metadata": {"path": str(path.parent)}}).execute()
    for cell, run in zip(notebook["cells"], live["cells"], strict=True):
        if cell["cell_type"] == "code":
            cell["outputs"], cell["execution_count"] = outputs_of(run), run["execution_count"]
            for foreign in FOREIGN:
                if foreign in json.dumps(cell["outputs"]):
                    raise SystemExit(f"{path.name}: an output names {foreign}")
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    print(path.name, flush=True)


if __name__ == "__main__":
    for each in [Path(name) for name in sys.argv[1:]] or sorted((ROOT / "notebooks").glob("*.ipynb")):
        execute(each)
