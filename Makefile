# make demo: the whole pipeline in the virtual lab.  make test: the tests.
# make test-fast: those that are not marked slow.
# make test-extras: the peers that benchmarks measure beside ours, the libraries of examples/, and notebooks.
# make dist: a wheel, which needs no clone, and the versions it is tested with.  make docs: the site, in site/.
# Each sets up by itself; nothing but Python 3.11 or newer and make is needed.

PYTHON ?= python3
BIN := .venv/bin
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

# Processes that run tests: four keep two cores busy, because many tests wait for others.
WORKERS ?= 4

# Without stored bytecode, each worker and each process that a test starts compiles all sources.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-fast test-extras dist docs format clean

demo: .venv/installed
	$(BIN)/neurosim demo demo

test: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(TIER) $(PYTEST_ARGS)

test-fast: TIER = -m "not slow"
test-fast: test

# What benchmarks/ and examples/ use, Ray and onnxruntime, which are large: 3.5 GB in all. Notebooks run, too.
test-extras: .venv/installed-extras
	NEUROSIM_EXTRAS=1 $(BIN)/pytest -n 2 --dist loadfile tests/extras tests/notebooks $(PYTEST_ARGS)

dist: .venv/installed-dev
	rm -rf dist
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .
	cp constraints.txt dist

docs: .venv/installed-dev
	$(BIN)/python docs/make_site.py

format: .venv/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "neurosim needs Python 3.11 or newer; name one with make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv .venv

.venv/installed: pyproject.toml constraints.txt | .venv/bin/python
	$(INSTALL) -e .
	touch $@

.venv/installed-dev: pyproject.toml constraints.txt | .venv/bin/python
	$(INSTALL) -e '.[dev]'
	touch $@ .venv/installed

.venv/installed-extras: pyproject.toml constraints.txt | .venv/bin/python
	$(INSTALL) -e '.[dev,bench,examples,onnx,ray]'
	touch $@ .venv/installed-dev .venv/installed

clean:
	rm -rf .venv build dist *.egg-info demo site
