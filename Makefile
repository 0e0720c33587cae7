# Everything a person needs to type. `make` alone says what there is.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

BIN := .venv/bin
TEST_JOBS ?= 2
TASK ?= OccludedGrasp-v1
ALL_TASKS ?= OccludedGrasp-v1 OccludedPickPlace-v1 TellApart-v1 KeyBag-Easy-v1 KeyBag-Hard-v1
export MUJOCO_GL ?= egl
export HF_HUB_DISABLE_TELEMETRY ?= 1
# Images for containers often set it: then each start compiles PyTorch and LeRobot again, which takes longer than all else of it.
unexport PYTHONDONTWRITEBYTECODE

# Each process takes half of what another has left: the tests of a module stay together, and all end at the same time.
PYTEST = $(BIN)/pytest -n $(TEST_JOBS) --dist worksteal --durations=15
BENCHMARKS ?= training acting windows recording environment

.PHONY: help install demo test test-slow test-lerobot lint docs links bench checks adversaries lock clean

help:  ## Lists the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

install: .venv/.installed  ## Makes .venv with pinned versions (PYTHON=... to choose the Python)

.venv/.installed: constraints.txt pyproject.toml envs/pyproject.toml tools/setup.sh
	PYTHON="$(PYTHON)" ./tools/setup.sh
	@touch $@

demo: install  ## Records, trains, evaluates and films, in 7 minutes on two fast cores
	PATH="$(CURDIR)/$(BIN):$$PATH" ./examples/demo.sh

lint: install  ## Style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint  ## Style, types and tests (TEST_JOBS=... processes side by side, default 2)
	./tools/test_programs.sh
	OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(PYTEST)

docs: install  ## The documentation site, in outputs/docs; a warning is an error
	$(BIN)/sphinx-build -W --keep-going -q docs outputs/docs

links:  ## Lists the links of the pages that lead elsewhere; nothing is fetched
	@grep -rhoE --include='*.md' 'https?://[^] )>"`]+' *.md docs | sort -u

test-slow: install  ## The tests that take minutes, side by side like the others
	OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(PYTEST) -m slow --timeout 3600

test-lerobot: BIN := .venv-lerobot/bin
test-lerobot:  ## The tests with another LeRobot, in .venv-lerobot (LEROBOT=... a checkout or a wheel)
	$(if $(LEROBOT),,$(error Which LeRobot? make test-lerobot LEROBOT=/path/to/checkout, or a wheel))
	PYTHON="$(PYTHON)" LEROBOT="$(LEROBOT)" ./tools/setup.sh
	OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(PYTEST)

bench: install  ## Measures speed beside alternatives, in a quarter of an hour (BENCHMARKS=...)
	for name in $(BENCHMARKS); do echo "== $$name"; $(BIN)/python benchmarks/$$name.py || exit 1; done

checks: install  ## Checks that version 1 of every task needs hearing, some hours (ALL_TASKS="...")
	for task in $(ALL_TASKS); do \
	  OMP_NUM_THREADS=1 $(BIN)/python -m gym_playbyear.check $$task --jobs=$(TEST_JOBS) \
	    --output=outputs/checks/$$task-check.json || [ $$? = 1 ]; done

adversaries: install  ## Trains the learned adversary, deaf and hearing, some hours in all (TASK=OccludedGrasp-v1)
	for hears in false true; do \
	  OMP_NUM_THREADS=1 $(BIN)/python examples/learned_adversary/learn.py --task=$(TASK) --hears=$$hears; done

lock: install  ## Writes the versions in .venv to constraints.txt
	VIRTUAL_ENV=$(CURDIR)/.venv $$(command -v $(BIN)/uv || command -v uv) pip freeze --exclude-editable \
	  | grep -E '^[A-Za-z0-9_.-]+==[^ ]+$$' > constraints.txt.new
	mv constraints.txt.new constraints.txt

clean:  ## Removes .venv, caches and outputs
	rm -rf .venv .venv-lerobot outputs .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
