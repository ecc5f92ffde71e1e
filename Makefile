# make setup | demo | test | test-all | fuzz | faults | check | docs | package | bench | accuracy | results | lock | clean
# A fresh clone needs python3 (3.11 to 3.13, for `make demo` alone 3.14 too; choose with PYTHON=python3.12), its venv and pip modules, and make.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
JOBS ?= auto
CORE_STAMP := $(VENV)/core.stamp
STAMP := $(VENV)/installed.stamp
KORNIA_STAMP := $(VENV)/kornia.stamp

# One BLAS thread: two on busy cores make a bundle adjustment many times slower. Must be set before numpy is imported.
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1
export PIP_DISABLE_PIP_VERSION_CHECK = 1
unexport PYTHONPATH

.PHONY: setup demo test test-all fuzz faults check docs package format bench accuracy results lock clean
.DEFAULT_GOAL := setup

setup: $(STAMP)

$(STAMP): pyproject.toml requirements/dev.lock
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if (3, 11) <= v[:2] < (3, 14) else "dualslam is developed on Python 3.11 to 3.13, but $(PYTHON) is %d.%d: make PYTHON=python3.12 setup" % v[:2])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --only-binary :all: --requirement requirements/dev.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

# What running needs, a third of all: enough for the demo where nothing is installed yet.
$(CORE_STAMP): pyproject.toml requirements/core.lock
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if (3, 11) <= v[:2] < (3, 15) else "dualslam needs Python 3.11 to 3.14, but $(PYTHON) is %d.%d: make PYTHON=python3.12 demo" % v[:2])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --only-binary :all: --requirement requirements/core.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

# torch and kornia, an extra of the size of all the rest: only the tests need them.
$(KORNIA_STAMP): $(STAMP) requirements/kornia.lock
	$(BIN)/python -m pip install --quiet --only-binary :all: --requirement requirements/kornia.lock
	@touch $@

demo: $(if $(wildcard $(STAMP)),$(STAMP),$(CORE_STAMP))
	$(BIN)/dualslam demo --out runs/demo --overwrite

# What is fast, on all cores: some minutes on two. Needs no torch.
test: setup
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(ARGS)

# Everything: slow tests, the kornia front end, the notebooks; and real sequences where DUALSLAM_DATA names their folder.
test-all: $(KORNIA_STAMP)
	$(BIN)/python -m pytest tests notebooks -m "slow or not slow" -n $(JOBS) --dist worksteal $(ARGS)

# Damaged images, cameras, maps, configurations, measurements and videos, by seed: make fuzz ARGS="--cases 10000"
fuzz: setup
	$(BIN)/python -m tests.fuzz $(ARGS)

# Runs that are interrupted, killed, out of disk or of workers, or whose solver fails, by seed: make faults ARGS="--kind kill"
faults: setup
	$(BIN)/python -m tests.fuzz.faults $(ARGS)

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/structure.py --budget tools/budget.toml

docs: setup
	$(BIN)/mkdocs build --quiet --strict

# A wheel and an sdist, each installed into an empty environment and run from elsewhere.
package: setup
	tools/try_package.sh $(BIN)/python dist

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: setup
	$(BIN)/python benchmarks/cost.py $(ARGS)

accuracy: setup
	$(BIN)/python benchmarks/sequences.py $(ARGS)

# Everything that README and docs/results.md claim: make results DATA=/folder/of/sequences ARGS="--part sequences"
results: setup
	$(BIN)/python benchmarks/results.py $(if $(DATA),--data $(DATA)) $(ARGS)

lock: setup
	$(BIN)/python tools/lock.py

clean:
	rm -rf $(VENV) dist build site runs/demo .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
