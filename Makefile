# Two commands do everything on a fresh machine: `make render` and `make test`.
PYTHON ?= $(shell for name in python3.11 python3.12 python3.13 python3; do $$name -c '' 2>/dev/null && command -v $$name && break; done)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# Exact versions that passed the test suite; pyproject.toml holds the ranges that are allowed.
PINS := -c .constraints.txt

.PHONY: help install render test test-slow stress lint format peers bench bench-peers paper paper-quick gpu-check docs wheel pythons clean
.DEFAULT_GOAL := help

help: ## Show this list.
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

install: $(VENV)/.installed ## Make .venv/bin/nlosrender, with an LLVM when the system has no usable one.

$(VENV)/.installed: pyproject.toml .constraints.txt
	@test -n "$(PYTHON)" || { echo "need Python 3.11, 3.12 or 3.13 (set PYTHON=...)"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || { echo "need Python 3.11, 3.12 or 3.13; $(PYTHON) is another version (set PYTHON=...)"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "python venv is missing: on Debian and Ubuntu, apt-get install python3-venv"; exit 1; }
	$(PIP) install $(PINS) --editable .
	@$(BIN)/python -c 'import sys; from nlosrender.engine.backend.llvm import choose_library; found = choose_library(); sys.exit(found is None or not found.is_proven)' \
		|| { echo "no LLVM known to work on this system: installing one into $(VENV)"; $(PIP) install $(PINS) --editable '.[llvm]'; }
	@touch $@

$(VENV)/.dev: $(VENV)/.installed
	$(PIP) install $(PINS) --editable '.[dev]'
	@touch $@

render: install ## Render configs/z-letter.yaml to out/: an HDF5 capture and a picture of it.
	@mkdir -p out
	$(BIN)/nlosrender render configs/z-letter.yaml -o out/z-letter.hdf5 --overwrite
	@echo "picture: $$($(BIN)/nlosrender plot out/z-letter.hdf5)"

# Bytecode is kept, whatever the environment says: without it each of the processes that tests start compiles the package.
test: export PYTHONDONTWRITEBYTECODE =
test: $(VENV)/.dev ## Run the default test suite.
	$(BIN)/python -m pytest -n logical --maxprocesses 4 --dist worksteal -m 'not slow and not peers and not stress'

test-slow: $(VENV)/.dev ## Run the tests that take longer.
	$(BIN)/python -m pytest -m slow

stress: $(VENV)/.dev ## Run the stress suite: laws under stress, fuzzed inputs; prints a table of both.
	$(BIN)/python -m pytest tests/stress

lint: $(VENV)/.dev ## Check style and types.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.dev ## Format the code.
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Other projects' packages live in an environment of their own: their requirements must not touch ours.
.venv-peers/.installed: .requirements-peers.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip --disable-pip-version-check --quiet install --no-deps -r $<
	@touch $@

peers: $(VENV)/.dev .venv-peers/.installed .venv-peers-mitransient/.installed ## Check our files in other projects' readers, imported scenes in their renderer.
	$(BIN)/python -m pytest -m peers

# MESH=bunny.ply, a mesh about 0.8 m high, adds scenes with it; SECONDS is the time for all measurements together.
bench: install ## Measure run time against error in 5 minutes: out/bench.json and out/bench.png. MESH=, SECONDS=
	$(BIN)/nlosrender bench --seconds $(or $(SECONDS),300) $(if $(MESH),--mesh $(MESH)) -o out/bench

.venv-peers-mitransient/.installed: .requirements-peers-mitransient.txt
	$(PYTHON) -m venv .venv-peers-mitransient
	.venv-peers-mitransient/bin/python -m pip --disable-pip-version-check --quiet install --no-deps -r $<
	@touch $@

bench-peers: install .venv-peers-mitransient/.installed ## The same, in turns with mitransient: out/bench-peers.json and .png. MESH=, SECONDS=
	$(BIN)/nlosrender bench --part curves --seconds $(or $(SECONDS),600) $(if $(MESH),--mesh $(MESH)) -o out/bench-peers \
		--peer '.venv-peers-mitransient/bin/python tests/peers/render_with_mitransient.py'

paper: install ## Reproduce the paper's figures and tables: out/paper/index.html. FIGURES='4 8'
	$(BIN)/nlosrender paper $(foreach name,$(FIGURES),--figure $(name)) -o out/paper

paper-quick: install ## The same with fewer points and paths, in minutes. FIGURES='4 8'
	$(BIN)/nlosrender paper --quick $(foreach name,$(FIGURES),--figure $(name)) -o out/paper

gpu-check: install ## Compare small captures on a GPU with those on the processor, and time both, in 5 minutes.
	$(BIN)/python tests/gpu/compare_backends.py -o out/gpu-check

docs: $(VENV)/.dev ## Build the docs site, with a reference of every key and command: out/site/index.html.
	$(BIN)/python -m sphinx -W --keep-going -q -c docs . out/site
	@echo "out/site/index.html"

wheel: $(VENV)/.dev ## Build the package: dist/nlosrender-VERSION-py3-none-any.whl.
	rm -rf build dist  # modules of an earlier build that are gone would be in the wheel
	$(PIP) wheel --no-deps --no-build-isolation --wheel-dir dist .
	@ls -s --block-size=KiB dist/*.whl

pythons: wheel ## Test the wheel with every other Python from 3.11 to 3.13 that is here: unit tests, commands from Python, docs.
	.ci/pythons $(BIN)/python

clean: ## Remove what make made, but not out/.
	rm -rf $(VENV) .venv-* build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
