PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
RUN := $(VENV)/bin/python

.PHONY: help setup demo test test-slow test-pythons lint types docs benchmark clean

help:            ## this list
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed -E 's/: .*##/\t/'

setup: $(VENV)/.installed  ## make the virtual environment with everything pinned

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: setup      ## a robot maps an unknown room and drives across it: runs/demo/report.html
	$(RUN) -m examples.navigate --out runs/demo --scene apartment --seed 0

test: setup      ## all tests but the slow ones, one process a core
	$(RUN) -m pytest -n auto --maxprocesses 8 --dist loadfile

test-slow: setup  ## the slow tests
	$(RUN) -m pytest -m slow

test-pythons: setup  ## tests and a core install on every Python from 3.10 to 3.13 that is here
	$(RUN) -m pip install --quiet --constraint constraints.txt nox
	$(RUN) -m nox

lint: setup      ## style and formatting
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

types: setup     ## static types
	$(VENV)/bin/mypy

docs: setup      ## the documentation, warnings as errors: build/site/index.html
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --quiet --strict

benchmark: setup  ## cost of a training step and of a planner iteration, as ratios
	$(RUN) -m benchmarks.step_cost

clean:           ## remove the environment and all results
	rm -rf $(VENV) runs build *.egg-info
