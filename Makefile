# Two commands, each of which does all set-up on a fresh machine that has Python 3.11 or 3.12, pip and make:
#
#   make demo    trains MALM on the shipped Swimmer demonstrations and leaves figures and a table in runs/demo
#   make test    lints, checks types and runs the tests
#
# Choices: PYTHON (interpreter), VENV (where the environment goes), JOBS (test processes), DEMO (arguments of the demo),
# DEMO_OUT (its folder; a run that was interrupted there is continued), PYTEST_ARGS (further arguments of pytest).
# `make help` lists all targets.

.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:

DEMO ?= --method malm --env Swimmer --num-seeds 3
DEMO_OUT ?= runs/demo
VENV ?= .venv
JOBS ?= $(or $(shell nproc 2>/dev/null),auto)

# The first of these that runs and suits; tried by running it, as a name in PATH may be a stub that only fails.
SUITS := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))
PYTHON ?= $(shell for p in python3.12 python3.11 python3; do "$$p" -c "$(SUITS)" 2>/dev/null && echo "$$p" && break; done)

# The tests of a file share what they have compiled, so they run in one process. Files come in the order that
# tests/conftest.py gives them: pytest-xdist would start those with the fewest tests last, and they are among the longest.
SHARED := --dist loadfile --no-loadscope-reorder
BIN := $(VENV)/bin
RUN := $(BIN)/python -m

.PHONY: help
help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1 - \2/p' Makefile

.PHONY: demo
demo: $(VENV)/.run ## set up, then train MALM on Swimmer with 3 seeds
	$(RUN) experiments.train $(DEMO) --out $(DEMO_OUT) $(if $(wildcard $(DEMO_OUT)/config.json),--resume)

.PHONY: test
test: lint types ## set up, then lint, check types and run the tests
	$(RUN) pytest -n $(JOBS) --maxprocesses=8 $(SHARED) $(PYTEST_ARGS)

.PHONY: test-slow
test-slow: $(VENV)/.dev ## the tests marked slow (long compilations and trainings)
	$(RUN) pytest -n $(JOBS) --maxprocesses=8 -m slow $(PYTEST_ARGS)

.PHONY: test-lowest
test-lowest: ## the tests with the lowest versions that pyproject.toml allows, in an environment of their own
	"$(PYTHON)" -m venv --clear "$(VENV)-lowest"
	"$(VENV)-lowest/bin/python" -m pip install --quiet --disable-pip-version-check uv
	"$(VENV)-lowest/bin/python" -m uv pip install --python "$(VENV)-lowest/bin/python" --resolution lowest-direct \
	  --editable ".[dev]"
	"$(VENV)-lowest/bin/python" -m pytest -n $(JOBS) --maxprocesses=8 $(SHARED) $(PYTEST_ARGS)

.PHONY: lint
lint: $(VENV)/.dev ## style
	$(RUN) ruff check .
	$(RUN) ruff format --check .

.PHONY: types
types: $(VENV)/.dev ## types
	$(RUN) mypy

.PHONY: docs
docs: $(VENV)/.dev ## the documentation as a site, in build/site
	NO_MKDOCS_2_WARNING=1 $(RUN) mkdocs build --strict

.PHONY: format
format: $(VENV)/.dev ## reformat, and fix what can be fixed
	$(RUN) ruff check --fix .
	$(RUN) ruff format .

.PHONY: setup
setup: $(VENV)/.dev ## the environment alone, with everything that the checks need

.PHONY: clean
clean: ## remove the environment, caches and builds; runs/ stays
	rm -rf $(VENV) $(VENV)-lowest .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist MUJOCO_LOG.TXT
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Stamps: made once, and again when the dependencies may have changed.
$(VENV)/.made:
	@"$(PYTHON)" -c "$(SUITS)" 2>/dev/null || { \
	  echo "Needs Python 3.11 or 3.12 with venv and ensurepip; found: '$(PYTHON)'."; \
	  echo "Name one: make $(MAKECMDGOALS) PYTHON=/path/to/python3.12"; exit 1; } >&2
	@echo "Making the environment $(VENV) with $$("$(PYTHON)" --version)"
	@"$(PYTHON)" -m venv --clear "$(VENV)"
	@touch $@

$(VENV)/.run: pyproject.toml | $(VENV)/.made
	@echo "Installing ccil_jax into $(VENV): about 1 GB, some minutes"
	@$(RUN) pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.dev: pyproject.toml | $(VENV)/.made
	@echo "Installing ccil_jax and its checks into $(VENV): about 2 GB, some minutes"
	@$(RUN) pip install --quiet --disable-pip-version-check --editable ".[dev]"
	@touch $(VENV)/.run $@
