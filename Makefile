# Two commands do everything on a fresh Debian machine with Python 3.11:
#   make demo    set up, run the main job on a built-in capture up to demo/run/review/report.html
#   make test    set up, check the code and run the tests
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
OUT ?= demo
export PYTHON
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: demo test test-fast lint bench docs settings package clean

demo: .stamps/core
	$(BIN)/geomocap demo $(OUT)

# What compares numbers of threads runs by itself with all cores; then the rest runs in two processes of one thread each,
# every file in one of them, those that take longest first.
ALONE := tests/geomocap/test_scheduling.py tests/geomocap/test_patches_tracking.py
SIDE_BY_SIDE := -n 2 --dist loadfile --no-loadscope-reorder $(addprefix --ignore=,$(ALONE)) \
	tests/test_accuracy.py tests/cli tests/viz tests

test: lint
	$(BIN)/python -m pytest $(ALONE)
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(SIDE_BY_SIDE)

test-fast: .stamps/dev
	$(BIN)/python -m pytest -m "not slow" $(ALONE) $(if $(REPORTS),--junitxml=$(REPORTS)/alone.xml)
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 \
		$(BIN)/python -m pytest -m "not slow" $(SIDE_BY_SIDE) $(if $(REPORTS),--junitxml=$(REPORTS)/rest.xml)

lint: .stamps/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .stamps/dev
	$(BIN)/python -m tests.benchmarks

# The pages, into site/: open site/index.html (the search wants a server: python -m http.server -d site).
docs: .stamps/dev
	$(BIN)/python -m tools.settings_page
	$(BIN)/python -m tools.results_page
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

# Wheel and source package, into dist/, installed and tried in a clean environment outside of this folder.
package: .stamps/dev
	tools/check_package.sh $(BIN)/python
# docs/settings.md, written from the settings models
settings: .stamps/dev
	$(BIN)/python -m tools.settings_page

# Python compiles what is used when it is used first; the tests use most of it, in many processes
# (a few packages bring files for other versions of Python, which can't be compiled). The pip that comes with Python 3.11
# takes twice as long as today's.
.stamps/core: pyproject.toml tools/system_packages.sh
	tools/system_packages.sh
	"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11) and "geomocap needs Python 3.11 or newer: make PYTHON=/path/to/python3.11 …")'
	"$(PYTHON)" -m venv $(VENV)
	$(BIN)/pip install -q --no-compile -U pip
	$(BIN)/pip install -q --no-compile -e .
	mkdir -p .stamps && touch $@

.stamps/dev: .stamps/core
	$(BIN)/pip install -q --no-compile -e '.[dev]'
	$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true
	touch $@

clean:
	rm -rf $(VENV) .stamps $(OUT) site build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
