# make demo   set up, simulate a small flame, reconstruct it, evaluate it: results in out/demo (two minutes)
# make test   set up, run the tests, then lint, types and the order of the rooms (make test-all: the long ones too)
# make app    set up, and work on out/demo (make demo) in the browser
# make docs   the documentation site: open docs/_build/html/index.html
# make links  external links of the documentation (needs the web)
# make dist   wheel and sdist in dist/, built and checked as the release workflow does (make dist-twice: the same twice?)
# make sbom   what an installation of the wheel of dist/ consists of, as CycloneDX: build/sbom.json
# make publication   addresses of pyproject.toml's table into every file (make publish-check: which are missing?)
# make study  the paper's numerical study (hours; benchmarks/study): out/study; make study-quick: a small one, out/study-quick

PYTHON ?= python3
BIN := .venv/bin
PIP := --quiet --disable-pip-version-check --no-compile  # byte code is written at the first import
COVERAGE ?= 50# per cent: what the tests of six of 17 folders reach (geometry, fields, physics, results, data, forward); more tests reach more
TORCH := torch $(if $(TORCH_INDEX),--no-deps --index-url $(TORCH_INDEX))
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadgroup --no-loadscope-reorder

# byte code is kept, also where the environment says otherwise: compiling at every start takes as long as the imports
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo app test test-all short-tests all-tests coverage lint docs links dist dist-twice sbom publication \
  publish-check study study-quick clean

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

coverage: .venv/.dev
	$(PYTEST) -m "not slow" --cov --cov-report=term --cov-fail-under=$(COVERAGE)

lint: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-logo
	$(BIN)/mypy

docs: .venv/.dev
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html

links: .venv/.dev
	$(BIN)/python -m sphinx -q -b linkcheck -D plot_gallery=0 docs docs/_build/links

# One time for all files: of the commit, or in an sdist of the release. The wheel is made from the sdist.
export SOURCE_DATE_EPOCH ?= $(shell git log -1 --format=%ct 2>/dev/null || date -u -d "$$(sed -n 's/^date-released: //p' CITATION.cff)" +%s)
DIST ?= dist

dist: .venv/.dist
	rm -rf $(DIST) build/sdist
	PIP_CONSTRAINT=constraints.txt $(BIN)/python -m build --sdist --outdir $(DIST)
	$(BIN)/python tools/reproducible_sdist.py $(DIST)/*.tar.gz
	umask 022; mkdir -p build/sdist; tar -xzf $(DIST)/*.tar.gz --strip-components 1 -C build/sdist; \
	  PIP_CONSTRAINT=constraints.txt $(BIN)/python -m build --wheel --outdir $(DIST) build/sdist
	$(BIN)/python -m twine check --strict $(DIST)/*
	$(BIN)/check-wheel-contents $(DIST)/*.whl
	ls -l $(DIST)

# clones with other permissions, in other folders: the same bytes
dist-twice: .venv/.dist
	rm -rf build/twice
	git clone -q . build/twice/one
	umask 077; git clone -q . build/twice/two/deeper
	for clone in one two/deeper; do ln -s $(CURDIR)/.venv build/twice/$$clone/.venv; \
	  $(MAKE) --no-print-directory -C build/twice/$$clone -o .venv/.dist dist DIST=dist > /dev/null || exit 1; done
	cd build/twice/one/dist && sha256sum * | tee ../../../sums
	cd build/twice/two/deeper/dist && sha256sum --check ../../../../sums

sbom: .venv/.sbom
	rm -rf build/sbom
	$(PYTHON) -m venv build/sbom
	build/sbom/bin/python -m pip install $(PIP) -c constraints.txt $(TORCH)
	build/sbom/bin/python -m pip install $(PIP) -c constraints.txt $(DIST)/*.whl
	rm build/sbom/lib/*/site-packages/nerif_bost-*/direct_url.json  # the folder of this build
	$(BIN)/cyclonedx-py environment --output-reproducible --output-file build/sbom.json build/sbom/bin/python

publication:
	$(PYTHON) tools/publication.py write

publish-check:
	$(PYTHON) tools/publication.py check

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

.venv/.sbom: .venv/.made
	$(BIN)/python -m pip install $(PIP) -c constraints.txt cyclonedx-bom
	touch $@

clean:
	rm -rf .venv build dist out docs/_build docs/_drawings docs/notebooks docs/repository
