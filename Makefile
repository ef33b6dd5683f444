# make run   evaluate on the embedded scenes (ARGS="scale=8 method=..." are handed on to eval.py)
# make test  lint, types and tests: what a change must pass
# make test-all  these and the nightly ones: campaigns, real Slurm, published peers, further ways to interrupt
# make unit  the unit tests alone, about a minute
# make fuzz  10,000 damaged, foreign and malicious files for every reader (ARGS="--rounds 3 --seed 1 -k polycam")
# make chaos commands that are killed and run at once (ARGS="--kills 3 -k upsample")
# make mistakes  inputs that can be computed with and are wrong: which are told (ARGS="--cases 500 --seed 0")
# make benchmark  speed ratios: dsr against plain implementations (ARGS="--json before.json")
# make dist  what a release consists of, built and checked, in dist
# make docs  the documentation as a site in outputs/site
# All of them set everything up in .venv first; they need Python >= 3.11 and nothing else.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
# One worker more than there are processors, as tests of commands wait for them; each computes with one thread.
# Modules are compiled once, also where the environment says otherwise: hundreds of processes import them.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder --maxprocesses 8 \
	--numprocesses $$(( $$(getconf _NPROCESSORS_ONLN) + 1 ))

.PHONY: run test test-all unit fuzz chaos mistakes lint docs dist benchmark clean

run: $(VENV)/installed
	$(BIN)/python eval.py $(ARGS)

test: lint
	$(PYTEST) -m "not nightly"

test-all: lint
	$(PYTEST)

unit: $(VENV)/installed-dev
	$(PYTEST) -m unit

fuzz: $(VENV)/installed-dev
	OMP_NUM_THREADS=1 nice -n 10 $(BIN)/python -m pytest --numprocesses 2 --rounds 33 tests/fuzz/test_fuzz.py $(ARGS)

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(VENV)/installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

dist: $(VENV)/installed-dev
	$(BIN)/python scripts/dist.py $(ARGS)

chaos: $(VENV)/installed-dev
	$(BIN)/python -m pytest --kills 9 tests/chaos $(ARGS)

mistakes: $(VENV)/installed-dev
	OMP_NUM_THREADS=1 PYTHONPATH=tests:benchmarks $(BIN)/python -m mistakes $(ARGS)

benchmark: $(VENV)/installed-dev
	$(BIN)/python benchmarks/run.py speed $(ARGS)

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: Python 3.11 or newer is needed; name one with PYTHON=..." >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: pyproject.toml setup.py constraints.txt | $(VENV)/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable .
	@touch $@

$(VENV)/installed-dev: pyproject.toml setup.py constraints.txt | $(VENV)/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,docs]'
	@touch $(VENV)/installed $@

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache
