# echelon: `make demo` for a first look, `make test` for all tests.  Everything lives in .venv; the system's Python is
# only used to make it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LOCKS := requirements.lock requirements-dev.lock requirements-bench.lock

.PHONY: help setup demo docs test lint bench lock clean
help: ## what can be made
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST)

$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "echelon needs Python 3.11 or newer, $(PYTHON) is $$($(PYTHON) -V 2>&1); try: make PYTHON=python3.12 …"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.run: requirements.lock pyproject.toml | $(VENV)/.made
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@

$(VENV)/.dev: requirements-dev.lock $(VENV)/.run
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-dev.lock
	@touch $@

$(VENV)/.bench: requirements-bench.lock $(VENV)/.run
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-bench.lock
	@touch $@

setup: $(VENV)/.run ## make .venv with the command `echelon` in it

demo: $(VENV)/.run ## the paper's nine robots as processes over Zenoh, without and with avoidance, and a report
	$(BIN)/echelon run paper --out runs/demo
	$(BIN)/echelon run paper --set avoidance.enabled=true --out runs/demo-avoidance
	$(BIN)/echelon report runs/demo runs/demo-avoidance --out runs/demo.html
	@echo "Look at runs/demo.html in a browser; runs/demo/ holds the recording, the CAN log and the summary."

docs: $(VENV)/.run ## docs/scenario.md, summary.schema.json and public-names.md, from their source
	$(BIN)/echelon schema scenario --markdown > docs/.new && mv docs/.new docs/scenario.md
	$(BIN)/echelon schema summary > docs/.new && mv docs/.new docs/summary.schema.json
	PYTHONPATH=tests $(BIN)/python -m support.public_names > docs/.new && mv docs/.new docs/public-names.md

test: $(VENV)/.dev ## all tests
	$(BIN)/python -m pytest $(ARGS)

lint: $(VENV)/.dev ## ruff, types, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.bench ## ticks per second beside peers doing the same work, and the other numbers of the README
	$(BIN)/python -m bench $(ARGS)

lock: $(VENV)/.dev ## resolve the dependencies anew
	$(BIN)/uv pip compile $(LOCK) pyproject.toml -o requirements.lock
	$(BIN)/uv pip compile $(LOCK) pyproject.toml --group dev -o requirements-dev.lock
	$(BIN)/uv pip compile $(LOCK) pyproject.toml --group dev --group bench -o requirements-bench.lock
LOCK := --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --upgrade

clean: ## forget .venv and what tools cached
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
