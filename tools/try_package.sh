#!/usr/bin/env bash
# Build a wheel and an sdist, install each into an empty environment, and run from a folder that holds nothing but a
# stranger's package `backend`. Usage: tools/try_package.sh PYTHON_WITH_HATCHLING OUT
set -euo pipefail
python="$1" out="$2"
root="$(cd "$(dirname "$0")/.." && pwd)"
rm -rf "$out"
mkdir -p "$out"
out="$(cd "$out" && pwd)"
scratch="$(mktemp -d)"
trap 'rm -rf "$scratch"' EXIT

(cd "$root" && "$python" -m hatchling build -d "$out" > /dev/null)
mkdir -p "$scratch/elsewhere/backend"
echo 'raise ImportError("a stranger is imported")' > "$scratch/elsewhere/backend/__init__.py"
unset PYTHONPATH

for package in "$out"/*.whl "$out"/*.tar.gz; do
  # The installed packages of the environment are not seen; versions are the locked ones.
  "$python" -m venv --clear "$scratch/venv"
  "$scratch/venv/bin/python" -m pip install --quiet --constraint "$root/requirements/dev.lock" "$package"
  (
    cd "$scratch/elsewhere"
    "$scratch/venv/bin/python" -c 'import dualslam, sys; assert dualslam.__file__.startswith(sys.prefix), dualslam.__file__'
    "$scratch/venv/bin/dualslam" run synthetic:street,frames=20,width=320,height=240 --out run --overwrite --quiet --workers 1
    test -s run/trajectory.txt
  )
  echo "$(basename "$package"): installed and run"
done
