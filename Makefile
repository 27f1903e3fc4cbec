# make demo   a scene is made, trained, encoded, and its file decoded and judged in a new process: 1 1/2 minutes on two idle cores
# make test   the tests of everyday work: four to five and a half minutes on two idle cores with AVX-512, eight and a half with AVX2
# make test-all   all tests; those that take long and guard what a change rarely breaks, too
# make lint   style and types
# make bounds the installation without extras, at the lowest versions that pyproject.toml allows, in a folder of its own
# make docs   the documentation as a site, in build/site
# make web    the page that shows scenes in a browser, from web/; needs node 20 or later, and npm
# Needs python3 (3.11 or later) and make; everything else is installed into .venv in this folder.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

# Idle OpenMP threads sleep instead of taking the cores from numba's.
export OMP_WAIT_POLICY ?= PASSIVE
# Bytecode is kept, whatever the shell says: tests start the program many times, and compiling its modules takes each
# time half a second.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo test test-all lint bounds docs web venv

help:
	@sed -n 's/^# make/make/p' Makefile

venv: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "Python 3.11 or later is needed, $$($(PYTHON) --version) was found; give another: make PYTHON=..."; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) \
		|| { echo "python3 -m venv failed; on Debian and Ubuntu it is in the package python3-venv"; exit 1; }
	@echo "installing CompGS and what it needs into $(VENV) (a few minutes the first time)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: venv
	@echo "== a scene: ray-traced objects, written as a capture would be"
	@$(BIN)/compgs demo-scene demo/scene --overwrite
	@echo "== training and encoding"
	@$(BIN)/compgs train demo/scene -o demo/run --preset quick --steps 2000 --overwrite
	@$(BIN)/compgs encode demo/run -o demo.cgs --overwrite --quiet
	@echo "== demo.cgs, decoded in a new process and rendered from the held-out views"
	@$(BIN)/compgs evaluate demo.cgs demo/scene -o demo/evaluation --overwrite
	@echo "== what takes how many bytes"
	@$(BIN)/compgs info demo.cgs
	@echo "== the same file in a web page, to open from disk"
	@$(BIN)/compgs export demo.cgs demo.html --overwrite

PYTEST := $(BIN)/python -m pytest --numprocesses auto --dist loadfile --durations=5

test: venv
	@$(PYTEST) -m 'not slow'

test-all: venv
	@$(PYTEST)

lint: venv
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/mypy

docs: venv
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build && echo "the site is build/site/index.html"

bounds:
	@$(PYTHON) tools/check_bounds.py

web:
	cd web && npm ci --ignore-scripts && npm run --silent build && npm run --silent declarations
	cp web/dist/page.html src/compgs/viewer/page.html
