# make demo   set up, simulate a small flame, reconstruct it, evaluate it: results in out/demo (two minutes)
# make test   set up, run the tests, then lint, types and the order of the rooms (make test-all: the long ones too)
# make app    set up, and work on out/demo (make demo) in the browser
# make docs   the documentation site: open docs/_build/html/index.html
# make dist   wheel and sdist in dist/, built and checked as the release workflow does
# make study  the paper's numerical study (hours; benchmarks/study): out/study; make study-quick: a small one, out/study-quick

PYTHON ?= python3
BIN := .venv/bin
PIP := --quiet --disable-pip-version-check --no-compile  # byte code is written at the first import
TORCH := torch $(if $(TORCH_INDEX),--no-deps --index-url $(TORCH_INDEX))
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadgroup --no-loadscope-reorder

# byte code is kept, also where the environment says otherwise: compiling at every start takes as long as the imports
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo app test test-all short-tests all-tests lint docs dist study study-quick clean

demo: .venv/.run
	$(BIN)/nerif demo --out out/demo --force

app: .venv/.app
	mkdir -p out/demo
	$(BIN)/nerif app out/demo

test: .venv/.dev
	$(MAKE) --no-print-directory --keep-going short-tests lint

test-all: .venv/.dev
	$(MAKE) --no-print-directory --keep-going all-tests lint

short-tests: .venv/.dev
	$(PYTEST) -m "not slow"

all-tests: .venv/.dev
	NERIF_CHECK_SHAPES=1 $(PYTEST)

lint: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-logo
	$(BIN)/mypy

docs: .venv/.dev
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html

dist: .venv/.dist
	rm -rf dist
	PIP_CONSTRAINT=constraints.txt $(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/check-wheel-contents dist/*.whl
	ls -l dist

study: .venv/.dev
	$(BIN)/python -m benchmarks run study --out out/study --data out/study --resume

study-quick: .venv/.dev
	$(BIN)/python -m benchmarks run study --quick --out out/study-quick --data out/study-quick --resume

.venv/.made: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "nerif needs Python 3.11 or newer; try make PYTHON=python3.11")'
	$(PYTHON) -m venv .venv
	touch $@

.venv/.run: .venv/.made
	$(BIN)/python -m pip install $(PIP) -c constraints.txt $(TORCH)
	$(BIN)/python -m pip install $(PIP) -c constraints.txt -e .
	touch $@

.venv/.app: .venv/.run
	$(BIN)/python -m pip install $(PIP) -c constraints.txt -e '.[app]'
	touch $@

.venv/.dev: .venv/.run
	$(BIN)/python -m pip install $(PIP) -c constraints.txt -e '.[dev]'
	touch $@

.venv/.dist: .venv/.made
	$(BIN)/python -m pip install $(PIP) -c constraints.txt build twine check-wheel-contents
	touch $@

clean:
	rm -rf .venv build dist out docs/_build docs/_drawings docs/notebooks docs/repository
