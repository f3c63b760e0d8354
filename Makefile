# The verbs of this repository. Each sets up .venv by itself: the first time, and again when the
# dependencies change. Any other Python: make test PYTHON=python3.12
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
# One thread for each process: parallel work is done by processes.
export OMP_NUM_THREADS ?= 1

.PHONY: help compare test lint format type
.DEFAULT_GOAL := help

help:
	@echo "make compare   learn the three games, compare with PPO, DQN and A2C: results/compare/report.html"
	@echo "               (FULL=1: more seeds, and the baselines also at ten times the steps)"
	@echo "make test      linter, types and tests"
	@echo "make lint | format | type"

$(READY): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --disable-pip-version-check --quiet -c constraints.txt -e ".[dev]"
	touch $@

compare: $(READY)
	$(BIN)/python scripts/compare_agents.py $(if $(filter-out 0,$(FULL)),--full) $(ARGS)

test: lint type
	$(BIN)/python -m pytest --numprocesses=auto --dist=loadfile $(ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

type: $(READY)
	$(BIN)/mypy
