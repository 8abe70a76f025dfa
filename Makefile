# echelon: `make demo` for a first look, `make test` for all tests.  Everything lives in .venv; the system's Python is
# only used to make it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# The quick part of the tests: rooms without input and output, and those that lean on a dependency.  No vcan, no wall clock,
# nothing marked `slow`.
QUICK := -m "not slow" tests/planning tests/plan tests/controller tests/agents tests/runtime \
  tests/bridge/protocols tests/bridge/timing tests/bridge/can tests/sim/results tests/sim/recording tests/sim/report \
  $(addprefix tests/cli/test_cli_help.py::, test_bash_knows_all_commands_and_all_options test_scripts_of_other_shells_know_the_commands)

.PHONY: help setup demo studies docs test test-quick test-lowest test-newest chaos lint bench bench-vmas lock clean
help: ## what can be made
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 20

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

studies: $(VENV)/.run ## the shipped studies into runs/studies, and the README's figure of the largest delays
	$(BIN)/echelon study all --out runs/studies --format svg
	cp runs/studies/epsilon/figures/delay/tolerated.svg docs/delays.svg

docs: $(VENV)/.run ## docs/scenario.md, schemas of summaries and analyses, public-names.md and the columns in sweep.md, from their source
	$(BIN)/echelon schema scenario --markdown > docs/.new && mv docs/.new docs/scenario.md
	$(BIN)/echelon schema summary > docs/.new && mv docs/.new docs/summary.schema.json
	$(BIN)/echelon schema analysis > docs/.new && mv docs/.new docs/analysis.schema.json
	PYTHONPATH=tests $(BIN)/python -m support.sweep_page > docs/.new && mv docs/.new docs/sweep.md
	PYTHONPATH=tests $(BIN)/python -m support.public_names > docs/.new && mv docs/.new docs/public-names.md

# Most tests wait for other processes and for clocks: files of tests run beside each other, in the order of tests/conftest.py.
JOBS ?= 2
test: $(VENV)/.dev ## all tests
	$(BIN)/python -m pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-quick: $(VENV)/.dev ## the quick part of the tests
	$(BIN)/python -m pytest $(QUICK) $(ARGS)

# Environments for other versions.  uv makes them, since it takes seconds where pip takes minutes.
$(VENV)-lowest/.made: requirements-lowest.lock pyproject.toml $(VENV)/.dev
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(VENV)-lowest
	$(BIN)/uv pip install --quiet --python $(VENV)-lowest --require-hashes -r requirements-lowest.lock
	$(BIN)/uv pip install --quiet --python $(VENV)-lowest --no-deps --editable .
	@touch $@

test-lowest: $(VENV)-lowest/.made ## the quick part with the lowest versions of all dependencies, in .venv-lowest
	$(VENV)-lowest/bin/python -m pytest $(QUICK) $(ARGS)

# The newest Python on this machine: of each python3.N on PATH and in pyenv the version and the place, the last counts.
NEWEST = $(shell (IFS=:; for folder in $$PATH; do ls "$$folder"/python3.*; done; ls "$${PYENV_ROOT:-$$HOME/.pyenv}"/versions/*/bin/python3.*) \
  2>/dev/null | grep -E '/python3[.][0-9]+$$' | while read -r python; do \
  "$$python" -c 'import sys, venv; v = sys.version_info; v.releaselevel == "final" and print("%d.%d.%d" % v[:3], sys.executable)'; \
  done 2>/dev/null | sort -V | tail -n 1)
DIGEST = import json, sys; print(json.load(open(sys.argv[1] + "/summary.json"))["trace_digest"])

test-newest: $(VENV)/.dev ## the quick part with the newest Python of this machine, in .venv-newest; `lab` must give the same digest
	@set -e; newest="$(NEWEST)"; version=$${newest%% *}; python=$${newest#* }; \
	own=$$($(BIN)/python -c 'import platform; print(platform.python_version())'); \
	[ "$${version%.*}" != "$${own%.*}" ] && [ "$$(printf '%s\n' "$$own" "$$version" | sort -V | tail -n 1)" = "$$version" ] || \
	  { echo "test-newest needs a Python newer than the $$own of $(VENV): on PATH or in pyenv the newest is $${version:-none}; or name one: make test-newest NEWEST='3.14.0 /path/to/python3.14'" >&2; exit 1; }; \
	echo "newest Python: $$version, $$python"; \
	$(BIN)/uv venv --quiet --clear --python "$$python" $(VENV)-newest; \
	$(BIN)/uv pip install --quiet --python $(VENV)-newest --require-hashes -r requirements-dev.lock; \
	$(BIN)/uv pip install --quiet --python $(VENV)-newest --no-deps --editable .
	$(VENV)-newest/bin/python -m pytest $(QUICK) $(ARGS)
	@set -e; folder=$$(mktemp -d); trap 'rm -rf "$$folder"' EXIT; \
	for venv in $(VENV) $(VENV)-newest; do \
	  $$venv/bin/echelon run lab --quiet --no-report --out "$$folder/$$venv" >/dev/null; \
	  digest=$$($$venv/bin/python -c '$(DIGEST)' "$$folder/$$venv"); \
	  echo "lab, $$($$venv/bin/python -V): $$digest"; \
	  [ "$${first:=$$digest}" = "$$digest" ] || { echo "test-newest: the digests of lab differ" >&2; exit 1; }; \
	done

chaos: $(VENV)/.dev ## five hundred runs that are killed, frozen, flooded and lied to; ARGS='--from 100 --plans 50', or --seed 7 for one
	$(BIN)/python -m chaos $(ARGS)

lint: $(VENV)/.dev ## ruff, types, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.bench ## ticks per second beside peers doing the same work, and the other numbers of the README
	$(BIN)/python -m bench $(ARGS)

# PyTorch's builds for processors alone are not on PyPI, whose own are larger, for graphics cards, too.  pip makes this
# environment, since its configuration can name where the small ones are.
$(VENV)-vmas/.made: requirements-vmas.txt | $(VENV)/.made
	$(BIN)/python -m venv --clear $(VENV)-vmas
	$(VENV)-vmas/bin/python -m pip install --quiet --disable-pip-version-check -r requirements-vmas.txt
	@touch $@

bench-vmas: $(VENV)/.run $(VENV)-vmas/.made ## many runs at once beside VMAS, in .venv-vmas; from then on `make bench` has its rows, too
	$(BIN)/python -m bench.batch $(ARGS)

lock: $(VENV)/.dev ## resolve the dependencies anew
	$(BIN)/uv pip compile $(LOCK) pyproject.toml -o requirements.lock
	$(BIN)/uv pip compile $(LOCK) pyproject.toml --group dev -o requirements-dev.lock
	$(BIN)/uv pip compile $(LOCK) pyproject.toml --group dev --group bench -o requirements-bench.lock
	$(BIN)/uv pip compile $(LOCK) --resolution lowest-direct pyproject.toml --group test -o requirements-lowest.lock
LOCK := --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --upgrade

clean: ## forget .venv, its relatives and what tools cached
	rm -rf $(VENV) $(VENV)-lowest $(VENV)-newest $(VENV)-vmas build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
