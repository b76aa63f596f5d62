# make sweep   install into .venv, run the tutorial's sweep, show where its results lie
# make test    install the test tools too, then lint, types and every test that can run here, but for the slowest
# make test-slow   those tests, which say that they were skipped in `make test`
# make unit    the tests of tests/unit, which start next to nothing, in some five minutes: while one works
# make learn   every preset with a score to reach, over five training seeds, in one table of score against target
# make kills   kill the drivers of small sweeps at many moments, resume them at once, check what is there: one table;
#              then service, drivers and database a hundred times
# make faults  kill drivers and training processes at random moments, COUNT of each (100), and lose what a sweep stands on:
#              a table; it goes on where it was cut, or anew with FRESH=--fresh
# make bench   the benchmarks, beside their peers, in one table
# make bench-search   what each search method finds on ARLBench's tasks; hours to days, goes on where it was stopped
# make bench-choice   what each way to choose a setting loses, from trainings that were done before (docs/choice.md)
# make docs    the site of all documentation, into site/: open site/index.html

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# torch first and pinned: whatever depends on it then takes it as it is.
TORCH := $(shell grep '^torch==' constraints.txt)

.PHONY: install sweep test test-slow unit lint types learn kills faults bench bench-choice bench-search docs clean

sweep: install
	$(BIN)/tune-jobs launch cartpole-ppo

install: $(VENV)/installed

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "tune-jobs needs Python 3.11 or newer; $(PYTHON) is older. Name another: make PYTHON=python3.11"; exit 5; }
	@base=$$($(PYTHON) -c 'import os, sys; print(os.path.realpath(sys._base_executable))') && \
		{ test ! -d $(BIN) || find $(BIN) -name 'python*' -type l -exec rm {} +; } && "$$base" -m venv $(VENV)

# One without pip was made by half, as where Debian's python3-venv is missing, or by uv; or its Python is gone, or another
# by now. Make takes nothing in it as done then: its links to Python are made anew, of what $(PYTHON) comes from, as that
# may be one of them; and packages that fit stay.
ifneq ($(shell $(BIN)/python -c 'import pip; print("sound")' 2> /dev/null),sound)
.PHONY: $(VENV)/bin/python $(addprefix $(VENV)/installed,-bench -docs -test) $(VENV)/installed
endif

# Editable, so that an edit acts at once; the wheel is tested on its own. pip compiles what it installs, one file after
# the other, which takes longer than the rest of its work: all cores do it at the end, but for files that aren't Python,
# and for a third of all, which nothing here imports, or next to nothing: packages' own tests, and some of what is large.
INSTALL := $(PIP) install --quiet --no-compile --constraint constraints.txt
RARE := site-packages/(.*/tests?|OpenGL|moto|networkx|pip|selenium|sympy)/
COMPILE := $(BIN)/python -W ignore -m compileall -qq -j 0 -x '$(RARE)' $(VENV)/lib || true

$(VENV)/installed: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) $(TORCH)
	$(INSTALL) --editable .
	@$(COMPILE)
	@touch $@

# At once and not upon the other, which would look for the versions of all once more. Box2D has wheels for some versions
# of Python only: without it what needs it is skipped, with the reason.
$(VENV)/installed-test: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) $(TORCH)
	$(INSTALL) --editable '.[test,docs]'
	$(INSTALL) --editable '.[box2d]' || echo "Box2D cannot be installed here"
	@$(COMPILE)
	@touch $(VENV)/installed $@

$(VENV)/installed-docs: $(VENV)/installed
	$(INSTALL) --editable '.[docs]'
	@$(COMPILE)
	@touch $@

# With the test tools and Box2D: the page is timed in the tests' browser, and LunarLander is among the works.
$(VENV)/installed-bench: $(VENV)/installed-test
	$(INSTALL) --editable '.[bench]'
	@$(COMPILE)
	@touch $@

# In six processes on two cores, as many of the tests wait for processes of their own: two for those in tests/ray, each
# with a Ray of its own and a file at a time, two for the unit tests, and two for the others, a file at a time and the
# longest first; with the types beside them.
# What they print, skipped tests with their reasons too, comes at the end. Processes by the hundred import the same
# modules: these are compiled once, whatever else the environment says.
OTHERS := tests/package/ $(filter-out tests/package/ tests/ray/ tests/unit/,$(sort $(dir $(wildcard tests/*/test_*.py))))
BY_FILE := --numprocesses=2 --dist=loadfile --no-loadscope-reorder
PYTEST := $(BIN)/python -m pytest --durations=15 --durations-min=5
test unit: export PYTHONDONTWRITEBYTECODE =
test: $(VENV)/installed-test lint
	@$(BIN)/mypy > $(VENV)/types.log 2>&1 & types=$$!; \
	$(PYTEST) $(BY_FILE) tests/ray > $(VENV)/tests-ray.log 2>&1 & ray=$$!; \
	$(PYTEST) --numprocesses=2 tests/unit > $(VENV)/tests-unit.log 2>&1 & unit=$$!; \
	$(PYTEST) $(BY_FILE) $(OTHERS); others=$$?; \
	wait $$unit; unit=$$?; cat $(VENV)/tests-unit.log; \
	wait $$ray; ray=$$?; cat $(VENV)/tests-ray.log; \
	wait $$types; types=$$?; cat $(VENV)/types.log; \
	exit $$((ray || unit || others || types))

test-slow: $(VENV)/installed-test
	TUNE_JOBS_SLOW=only $(PYTEST)

unit: $(VENV)/installed-test
	$(BIN)/python -m pytest --quiet --numprocesses=3 tests/unit

lint: $(VENV)/installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/installed-test
	$(BIN)/mypy

learn: $(VENV)/installed-test
	$(BIN)/python -m tests.learning

kills: $(VENV)/installed-test
	$(BIN)/python -m tests.kills
	TUNE_JOBS_NUM_KILLS=50 $(BIN)/python -m pytest --quiet tests/integration/test_service_kills.py

COUNT ?= 100
faults: $(VENV)/installed-test
	$(BIN)/python -m tests.faults --count $(COUNT) $(FRESH)

bench: $(VENV)/installed-bench
	$(BIN)/python -m tests.benchmarks

bench-choice: $(VENV)/installed-test
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.benchmarks.choice

bench-search: $(VENV)/installed-test
	OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python -m tests.benchmarks.search

# Warnings, links that lead nowhere among them, are errors; with --quiet they would not be.
docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build
	@echo site/index.html

clean:
	rm -rf $(VENV) build site *.egg-info .mypy_cache .ruff_cache .pytest_cache
