# Every target calls idempotent commands: what the results folder holds already is not done again.
# What a target runs on which grid stands in studies/runs/<case>.toml; studies/run.py runs it.
.DEFAULT_GOAL := help
.PHONY: help venv instances train-ko solve-baselines train-dpc solve-dpc bench report online suite quick radau \
  models certify docs test types tests clean

PYTHON    ?= python3
CASE      ?= 9bus
CASES     ?= 9bus two-area 39bus 68bus 140bus
RESULTS   ?= results/$(notdir $(CASE:/=))
SPLIT     ?= test
WORKERS   ?= $(shell nproc 2>/dev/null || echo 2)
REGIME    ?=
LIMIT     ?=
SCENARIOS ?=
TIMED     ?=
KOOPMAN   ?=
TRAIN     ?=
BENCH     ?=
BIN       := .venv/bin
STAMP     := .venv/installed
RUN       := $(BIN)/python studies/run.py
# One step of the road of a case, with everything that the user said.
STEP       = $(RUN) $@ --case "$(CASE)" --results "$(RESULTS)" --split "$(SPLIT)" --workers "$(WORKERS)" \
  --regime "$(REGIME)" --limit "$(LIMIT)" --scenarios "$(SCENARIOS)" --timed "$(TIMED)" \
  --koopman="$(KOOPMAN)" --train="$(TRAIN)" --bench="$(BENCH)"

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  Settings: CASE=$(CASE) RESULTS=$(RESULTS) SPLIT=test|train|validation|all REGIME=r LIMIT=n WORKERS=$(WORKERS)"
	@echo "    SCENARIOS=n TIMED=n; further options of commands: KOOPMAN=\"--count 24\" TRAIN=\"--seconds 60\" BENCH=..."
	@echo "  CASE: a shipped case ($(CASES), and the islands two-area-agc ...) or a folder"

venv: $(STAMP)  ## make .venv with the pinned versions
$(STAMP): constraints.txt setup.cfg pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

instances: $(STAMP)  ## draw the instances and their split (the same files every time)
	$(BIN)/ded-bench instances --case $(CASE)

train-ko:         ## identify the Koopman model from simulated trajectories
solve-baselines:  ## solve and score static dispatch, DED and DED-KO in all regimes
radau:            ## full DED by Radau collocation: the accurate reference
train-dpc:        ## train the policies on the training instances
solve-dpc:        ## solve and score with the policies
models:           ## DED-KO on other models of the dynamics
bench:            ## everything that is missing, then time each method alone on the machine
report:           ## the same, then the tables and the report
online:           ## the closed loop: all methods at their own latency, then sweeps over latency and forecast
certify:          ## certify the policy on fresh instances
train-ko solve-baselines radau train-dpc solve-dpc models bench report online certify: $(STAMP)
	$(STEP)

suite: $(STAMP)  ## the reports of the lossless grids, then one page over them
	for case in $(CASES); do $(MAKE) report CASE=$$case RESULTS=results/$$case || exit 1; done
	$(BIN)/ded-bench overview --results $(CASES:%=results/%)

quick: $(STAMP)  ## the same road with 4 instances (1 for full DED) and little training, two to three minutes
	$(RUN) report --runs quick --results results/quick --limit 4 --workers "$(WORKERS)"

docs: $(STAMP)  ## the API reference, from docstrings and types, in build/reference
	$(BIN)/python docs/reference.py build/reference

test: $(STAMP)  ## lint, type check and tests
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(MAKE) --no-print-directory -j 2 types tests

# mypy has one process, and its half minute is not waited for.
types: $(STAMP)
	$(BIN)/mypy

# Each process has tests that stand together, and so share their fixtures.
# A hundred processes import the package: bytecode is kept, whatever the environment says.
tests: $(STAMP)
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

clean:  ## remove the virtual environment, caches and results/quick (other results stay)
	rm -rf .venv build *.egg-info .pytest_cache .mypy_cache .ruff_cache results/quick
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
