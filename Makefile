# Canopy. `make` lists what there is; everything that needs the environment sets it up first.

PYTHON ?= python3
PYTEST_ARGS ?= --numprocesses=2

VENV := .venv
STAMP := $(VENV)/.set-up
PIP_INSTALL := $(PYTHON) -m pip --python $(VENV)/bin/python --disable-pip-version-check --no-input \
	install --quiet
PYTEST := $(VENV)/bin/python -m pytest

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.SILENT:
.PHONY: help setup demo test test-slow test-long soak check format bench clean distclean

help: ## List these targets
	sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(firstword $(MAKEFILE_LIST)) | expand -t 20

setup: $(STAMP) ## Prepare .venv and the command .venv/bin/canopy

$(STAMP): requirements.lock pyproject.toml
	command -v $(PYTHON) >/dev/null || { \
		echo "setup: no $(PYTHON) on this machine: install Python 3.11 or later," \
			"or say 'make setup PYTHON=/path/to/python3'" >&2; exit 1; }
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "setup: Canopy needs Python 3.11 or later, but $(PYTHON) is" \
			"$$($(PYTHON) -c 'import platform; print(platform.python_version())'):" \
			"say 'make setup PYTHON=/path/to/python3.11'" >&2; exit 1; }
	$(PYTHON) -c 'import venv' 2>/dev/null || { \
		echo "setup: $(PYTHON) lacks the module venv: on Debian, apt install python3-venv" >&2; \
		exit 1; }
	$(PYTHON) -m pip --version >/dev/null 2>&1 || { \
		echo "setup: $(PYTHON) lacks pip: on Debian, apt install python3-pip" >&2; exit 1; }
	$(PYTHON) -m pip --help | grep -q -e '--python ' || { \
		echo "setup: the pip of $(PYTHON) is too old: 22.3 or later is needed, found" \
			"$$($(PYTHON) -m pip --version | cut -d' ' -f2)" >&2; exit 1; }
	if ! $(VENV)/bin/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
		echo "setup: creating $(VENV) with Python" \
			"$$($(PYTHON) -c 'import platform; print(platform.python_version())')"; \
		$(PYTHON) -m venv --clear --without-pip $(VENV); \
	fi
	echo "setup: installing requirements.lock (hashes checked); half a minute the first time"
	$(PIP_INSTALL) --require-hashes -r requirements.lock
	echo "setup: installing Canopy itself (editable)"
	$(PIP_INSTALL) --no-deps --no-build-isolation --editable .
	touch $@
	echo "setup: done: $(VENV)/bin/canopy"

demo: $(STAMP) ## Set up, then play the demonstration scenario
	$(VENV)/bin/canopy run deploy/scenarios/demo.toml

test: $(STAMP) ## Run the quick tests
	$(PYTEST) -m "not slow and not long" $(PYTEST_ARGS)

# Exit code 5 means that no test is marked so, which is no failure here.
test-slow: $(STAMP) ## Run the slow tests
	$(PYTEST) -m slow $(PYTEST_ARGS) || [ $$? -eq 5 ]

test-long: $(STAMP) ## Run the tests that take an hour
	$(PYTEST) -m long $(PYTEST_ARGS)

soak: $(STAMP) ## Random scenarios under random faults, for MINUTES=10, from SEED
	$(VENV)/bin/python -m experiments.soak --minutes $(or $(MINUTES),10) $(if $(SEED),--seed $(SEED))

check: $(STAMP) ## Lint, formatting, types, floors, reference up to date
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/mypy
	$(PYTEST) --quiet tests/test_floors.py
	$(VENV)/bin/python docs/generate_scenario.py --check

format: $(STAMP) ## Format the code and sort its imports
	$(VENV)/bin/ruff check --select I --fix --quiet
	$(VENV)/bin/ruff format

bench: $(STAMP) ## Run the benchmarks
	$(VENV)/bin/python benchmarks/run.py

clean: ## Remove caches and build artefacts (keeps .venv and runs/)
	rm -rf build dist *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -path ./$(VENV) -prune -o -path ./runs -prune -o -name __pycache__ -type d -print0 \
		| xargs -0 -r rm -rf

distclean: clean ## As clean, and remove .venv too
	rm -rf $(VENV)
